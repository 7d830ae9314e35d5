"""Stage `dataset`: versioned synthetic data sets with sampled ray drop and range noise, and a manifest.

Rendering is deterministic; a real scan is not. Here each ray of the rendered grid is sampled as return or
drop by its hit probability, and each range gets the sensor's noise, from the data set's own seed.
"""

import importlib.metadata
import json
import platform
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from nvsf_core._types import Scalar
from nvsf_core.drives.catalogue import ViewEntry
from nvsf_core.errors import StoreError
from nvsf_core.metrics.table import mean_rows
from nvsf_core.reporting.previews import image_preview, scan_top_view
from nvsf_core.simulation.scan import GRID_ARRAYS
from nvsf_core.stages.exports.manifest import (
    CHECKSUMS,
    MANIFEST_NAME,
    SEAL,
    damaged_data_set,
    stored_number,
)
from nvsf_core.stages.exports.of_view import RenderedView
from nvsf_core.stages.exports.write import finish_data_set, rewrite_manifest, write_data_set
from nvsf_core.stages.flow import DATASET, FIELD, NOVEL_VIEWS, SCENE_METRICS
from nvsf_core.stages.inputs import clock_origin_s
from nvsf_core.stages.runner.facts import view_facts
from nvsf_core.stages.runner.host import code_commit
from nvsf_core.stages.runner.record import content_of, read_record
from nvsf_core.stages.runner.stage import Check, StageOutput, Task
from nvsf_core.stages.views.instances import boxes_of
from nvsf_core.stores.arrays import read_arrays, read_attrs
from nvsf_core.stores.checksums import json_digest
from nvsf_core.stores.documents import read_document
from nvsf_core.stores.removal import carry_pin, removal_of
from nvsf_core.stores.tables import read_rows

VERSIONS_NAME = "versions.json"
_ERROR_KEYS = ("split", "region", "protocol", "sensor", "metric", "value", "n_frames", "n_defined")
_NOT_RENDERED = frozenset({"exports", "hits", "range_noise_m", "truth"})
"""Keys of a view that decide nothing of its rendering."""
_PACKAGES = ("nvsf", "numpy", "scipy", "torch", "numba", "zarr", "pyarrow", "opencv-contrib-python-headless")


def dataset_version(task: Task, view: ViewEntry, sources: Mapping[str, str]) -> str:
    """Version name `<label>-<8 hex digits>`, of the SHA-256 over all that decides the data set's content.

    That is recipe, seeds, view, checksums of the recorded files, the model and all else that it is rendered
    from, and the code's versions: what differs in content differs in name.
    """
    facts = {
        "recipe": task.config.recipe.identity(),
        "seed": task.config.seed,
        "draw_seed": task.config.draw_seed,
        "view": _facts_of(view),
        "sources": dict(sources),
        "licence": task.scene.licence,
        "rendered_from": _rendered_from(task),
        "code": [NOVEL_VIEWS.version, DATASET.version],
    }
    return f"{task.config.dataset_label}-{json_digest(facts)[:8]}"


def _rendered_from(task: Task) -> dict[str, str]:
    """Stage to the content of its output, of those that a view is rendered from; the mesh is a baseline's."""
    found = {}
    for name in sorted({*NOVEL_VIEWS.inputs} - {"mesh"}):
        place = f"{name}/{task.config.recipe.name}/{task.config.seed}" if name == FIELD.name else name
        record = read_record(task.store.path(place))
        if record is not None:
            found[name] = content_of(record)
    return found


def is_there(task: Task, location: str) -> bool:
    """Whether a version of a data set was published before and is whole: its files then stay as they are."""
    folder = task.store.recovered(location)
    return damaged_data_set(folder) is None and bool(_rendered_from(task))


def run(task: Task) -> StageOutput:
    """Export each view as a version of its data set; the stage `dataset`."""
    rendered = task.store.require(NOVEL_VIEWS.location(task.config))
    sources = source_checksums(task)
    metrics = _field_metrics(task)
    held_out = ViewEntry(name="test", exports=("bin", "ply"))
    output = StageOutput()
    made: list[dict[str, Any]] = []
    late = _asked_since(task, rendered)
    for view in (held_out, *task.scene.views):
        if view.name in late or not (rendered / view.name / "model.zarr").is_dir():
            reason = late.get(view.name) or _why_absent(rendered, view.name)
            output.metadata[view.name] = reason
            task.progress(f"[{task.scene.name}] dataset: {view.name} {reason}")
            continue
        version = dataset_version(task, view, sources)
        location = f"dataset/{view.name}/{version}"
        removal = removal_of(task.store, location)
        if removal is not None:
            output.beside.append(location)
            output.metadata[view.name] = removal.words
            continue
        arrays = _read_view(rendered / view.name / "model.zarr")
        attrs = read_attrs(rendered / view.name / "model.zarr")
        measured = [row for row in metrics if row["split"] in ("test", view.name)]
        rendering = {k: v for k, v in attrs.items() if _is_plain(v)}
        if is_there(task, location):
            _follow_metrics(task, location, {"rendering": rendering, "field_metrics": measured})
        else:
            with task.store.publish(location) as folder:
                rendered_view = RenderedView(
                    scene=task.scene.name, sequence=task.scene.sequence, entry=view, config=task.config,
                    arrays=arrays, attrs=attrs, origin_s=clock_origin_s(task.store),
                )  # fmt: skip
                manifest = {
                    **identity_of(task, view, version),
                    "drawn": rendered_view.what_was_sampled(),
                    "rendering": rendering,
                    "source_checksums": sources,
                    **write_data_set(folder, rendered_view, boxes_of(task.store)),
                    "field_metrics": measured,
                }
                finish_data_set(folder, manifest)
                carry_pin(task.store.path(location), folder)
        written = read_document(task.store.path(location) / MANIFEST_NAME)
        scans, pictures = written["scans"], written["images"]
        output.beside.append(location)
        entry = _summary(task.store.path(location), location, view.name, version, scans, pictures)
        made.append(entry)
        _preview(task.folder, view, arrays, output)
        task.progress(
            f"[{task.scene.name}] dataset: {location}, {len(scans)} scans, {len(pictures)} pictures,"
            f" {entry['megabytes']:.1f} MB"
        )
    (task.folder / VERSIONS_NAME).write_text(json.dumps(made, indent=1))
    output.metadata |= _metadata(made)
    output.checks = _checks(made)
    if late:
        detail = "; ".join(f"{name} {reason}" for name, reason in late.items())
        output.checks.append(Check(name="views_are_rendered_as_asked", passed=False, detail=detail))
    return output


def identity_of(task: Task, view: ViewEntry, version: str) -> dict[str, Any]:
    """The manifest's entries on the origin of the data set."""
    recipe = task.config.recipe
    return {
        "scene": task.scene.name,
        "sequence": task.scene.sequence,
        "view": _facts_of(view),
        "version": version,
        "recipe": {**recipe.to_json(), "identity": recipe.identity()},
        "seed": task.config.seed,
        "draw_seed": task.config.draw_seed,
        "licence": task.scene.licence,
        "commit": code_commit(),
        "software": _software(),
        "rendered_from": _rendered_from(task),
    }


def failed_checks(folder: Path) -> list[Check]:
    """The checks that a written data set alone fails."""
    made = read_document(folder / MANIFEST_NAME)
    name, version = made["view"]["name"], made["version"]
    found = _checks([_summary(folder, "", name, version, made["scans"], made["images"])])
    return [check for check in found if not check.passed]


def _follow_metrics(task: Task, location: str, found: Mapping[str, Any]) -> None:
    """Write manifest and card of a version that is there anew, if other errors are measured now.

    They do where a view's truth became known later, metrics were measured anew, or `render_view` made it.
    Of `found`, `rendering` is taken where the manifest has none, `field_metrics` always.
    """
    folder = task.store.path(location)
    written = dict(read_document(folder / MANIFEST_NAME))
    if _errors(written.get("field_metrics", [])) == _errors(found["field_metrics"]):
        return
    kept = {CHECKSUMS: {}} | {key: value for key, value in written.items() if key != SEAL}
    rewrite_manifest(folder, {**found, **kept, "field_metrics": found["field_metrics"]})
    task.progress(f"[{task.scene.name}] dataset: {location}, its card says what was measured since")


def _errors(rows: list[dict[str, Any]]) -> list[list[Any]]:
    """What rows of mean metrics say of errors, without the seconds that these took."""
    return [[row.get(key) for key in _ERROR_KEYS] for row in rows]


def _facts_of(view: ViewEntry) -> dict[str, Any]:
    """The view's entry without its true images, which no data set is made from."""
    return {key: value for key, value in asdict(view).items() if key != "truth"}


def _asked_since(task: Task, rendered: Path) -> dict[str, str]:
    """Views that are not rendered as the catalogue asks for them now, each with the reason in words.

    It may have changed since, where this stage is run alone or while a run goes on; a manifest that says what
    is asked for now would then lie about what was rendered.
    """
    known = (read_record(rendered) or {"facts": {}})["facts"].get("views")
    if known is None:
        return {}
    then, found = {view["name"]: view for view in known}, {}
    for now in view_facts(task.scene):
        before = then.get(now["name"])
        if before is None:
            found[now["name"]] = "not rendered yet: it was asked for since; run novel_views, then this again"
            continue
        keys = sorted(key for key in {*before, *now} - _NOT_RENDERED if before.get(key) != now.get(key))
        if keys:
            found[now["name"]] = (
                f"left out: rendered before {', '.join(keys)} changed in the catalogue; run novel_views, "
                "then this again"
            )
    return found


def _why_absent(rendered: Path, view: str) -> str:
    """Why `novel_views` published no such view, by its record."""
    said = (read_record(rendered) or {"metadata": {}})["metadata"]
    return str(said.get(view, "not rendered: none of its frames was recorded"))


def _read_view(path: Path) -> dict[str, np.ndarray]:
    """All arrays of a rendered view.

    Raises:
        StoreError: Values are NaN (no return is infinite or 0, never NaN), or arrays of the grid are missing.
    """
    arrays = read_arrays(path)
    for name in ("points_m", "intensity", *GRID_ARRAYS):
        broken = int(np.isnan(arrays[name]).sum()) if name in arrays else 0
        if broken:
            raise StoreError(f"{path}: {name} holds {broken} NaN, expected numbers; make novel_views anew")
    present = [name for name in GRID_ARRAYS if name in arrays]
    if present and len(present) != len(GRID_ARRAYS):
        raise StoreError(f"{path}: expected all of {GRID_ARRAYS}, found {present}; make novel_views anew")
    return arrays


def source_checksums(task: Task) -> dict[str, str]:
    """Checksum of each recorded file that the scene was built from, by kind and frame."""
    folder = task.store.require("frames")
    sources = {
        f"scan {row['frame']:010d}": row["checksum"]
        for row in read_rows(folder / "frames.parquet")
        if row["checksum"]
    }
    if (folder / "cameras.parquet").is_file():
        for row in read_rows(folder / "cameras.parquet"):
            if row["checksum"]:
                sources[f"{row['camera']} {row['frame']:010d}"] = row["checksum"]
    return sources


def _field_metrics(task: Task) -> list[dict[str, Any]]:
    """Means over frames of the field's metrics, their numbers as strict JSON holds them."""
    config = task.config
    path = task.store.require(SCENE_METRICS.location(config)) / "metrics.parquet"
    return [
        {name: stored_number(value) if isinstance(value, float) else value for name, value in row.items()}
        for row in mean_rows(read_rows(path))
        if row["recipe"] == config.recipe.name
    ]


def _software() -> dict[str, str]:
    versions = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = "absent"
    return versions


def _is_plain(value: Any) -> bool:
    """Whether strict JSON can hold the value; it cannot hold NaN and infinity."""
    try:
        json.dumps(value, allow_nan=False)
    except (TypeError, ValueError):
        return False
    return True


def _summary(
    folder: Path, location: str, view: str, version: str, scans: list[dict[str, Any]], pictures: list[Any]
) -> dict[str, Any]:
    sizes_match = all(
        (folder / scan["files"]["bin"]).stat().st_size == 16 * scan["returns"]
        for scan in scans
        if "bin" in scan["files"]
    )
    return {
        "view": view,
        "version": version,
        "location": location,
        "scans": len(scans),
        "images": len(pictures),
        "returns_min": min((scan["returns"] for scan in scans), default=0),
        "returns_mean": sum(scan["returns"] for scan in scans) / max(1, len(scans)),
        "sizes_match": sizes_match,
        "megabytes": sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 1e6,
    }


def _preview(folder: Path, view: ViewEntry, arrays: Mapping[str, np.ndarray], output: StageOutput) -> None:
    if "points_m" in arrays and len(arrays["offsets"]) > 1:
        points_m = arrays["points_m"][arrays["offsets"][0] : arrays["offsets"][1]]
        (folder / f"{view.name}_from_above.png").write_bytes(scan_top_view(points_m))
        output.previews[f"{view.name} from above"] = f"{view.name}_from_above.png"
    for camera in sorted(name for name in arrays if name.endswith("_rgb"))[:1]:
        if len(arrays[camera]):
            (folder / f"{view.name}_{camera}.png").write_bytes(image_preview(arrays[camera][0]))
            output.previews[f"{view.name} {camera.removesuffix('_rgb')}"] = f"{view.name}_{camera}.png"


def _metadata(made: list[dict[str, Any]]) -> dict[str, Scalar]:
    size_mb = sum(entry["megabytes"] for entry in made)
    metadata: dict[str, Scalar] = {"data_sets": len(made), "size_mb": size_mb}
    for entry in made:
        metadata[f"{entry['view']}_version"] = entry["version"]
        metadata[f"{entry['view']}_scans"] = entry["scans"]
        metadata[f"{entry['view']}_returns_mean"] = entry["returns_mean"]
    return metadata


def _checks(made: list[dict[str, Any]]) -> list[Check]:
    bare = [entry["view"] for entry in made if not entry["scans"] and not entry["images"]]
    empty = [entry["view"] for entry in made if entry["scans"] and entry["returns_min"] == 0]
    wrong = [entry["view"] for entry in made if not entry["sizes_match"]]
    return [
        Check(
            name="every_view_holds_scans_or_images",
            passed=not bare,
            detail=f"{len(made)} views, {bare or 'none'} of them without",
            blocking=True,
        ),
        Check(
            name="every_scan_has_returns",
            passed=not empty,
            detail=f"views with an empty scan: {empty or 'none'}",
        ),
        Check(
            name="every_bin_is_16_bytes_a_return",
            passed=not wrong,
            detail=f"views whose files have another size: {wrong or 'none'}",
            blocking=True,
        ),
    ]
