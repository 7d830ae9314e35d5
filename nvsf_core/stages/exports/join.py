"""Joins the data sets of a cut drive's parts into one, file by file."""

import json
import math
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nvsf_core.drives.catalogue import home_from_environment
from nvsf_core.drives.drive import own_folders, require_outside
from nvsf_core.drives.entries import SceneEntry
from nvsf_core.drives.kitti360.writer import read_numbers, write_grey
from nvsf_core.errors import DataError
from nvsf_core.metrics.table import HELD_OUT
from nvsf_core.stages.exports.manifest import (
    MANIFEST_NAME,
    SEAL,
    asked_of,
    damaged_data_set,
    number_of,
    stored_number,
)
from nvsf_core.stages.exports.one_drive import on_one_clock, with_shared_objects
from nvsf_core.stages.exports.write import WHOLE, finish_data_set
from nvsf_core.stages.kept_versions import in_order
from nvsf_core.stages.runner.own_places import require_place_of_yours
from nvsf_core.stores.scene_store import SceneStore, new_folder

_COUNTS = ("n_frames", "n_defined")
_COSTS = ("train_seconds", "parameters", "model_mb")
"""Of each part's own model: those of the drive are their sums."""
_OF_A_PART = ("scene", "value", "render_seconds", *_COUNTS, *_COSTS)
"""Columns of a mean error that differ between parts."""
_SAME = ("recipe", "seed", "draw_seed", "cameras", "schema_version")
"""What the parts' data sets must have in common."""
_OF_ITS_MODEL = ("source_checksums", "rendered_from", "rendering", "drawn")
"""Entries on one part's model, which stand with the part."""
_ROUNDING = 1e-6
_Part = tuple[SceneEntry, range, Path]
"""A part, the frames that are its own, and the folder of its data set."""


def join_data_sets(
    name: str, parts: Sequence[tuple[SceneEntry, range]], folders: Sequence[Path | None], out: Path
) -> Path:
    """Write one data set of the frames that are each part's own, on the clock of the first part.

    Scans, images and the files beside them are joined; whole trees in one (`kitti`, `mcap` ...) are
    not. These, and parts without the view, are named in the manifest.

    Args:
        name: Of the scene that was cut.
        parts: The parts, and the frames that are their own.
        folders: Each part's data set of the same view; None = the part has none of its frames.
        out: Folder to make.

    Returns:
        `out`.

    Raises:
        DataError: The data sets are not of one recipe, seed and view, are not of recorded frames, or `out`
            is taken, in the drive, or belongs to the outputs in NVSF_HOME.
    """
    if out.exists():
        raise DataError(f"{out}: expected a folder to be made, found one that is there; name another")
    require_outside(out, [own for part, _ in parts for own in own_folders(part)])
    require_place_of_yours(out, home_from_environment(os.environ))
    asked = [(*one, folder) for one, folder in zip(parts, folders, strict=True) if folder is not None]
    manifests = _manifests_of_one_view(asked)
    without = [part.name for (part, _), folder in zip(parts, folders, strict=True) if folder is None]
    try:
        with new_folder(out) as folder:
            first_frames = [part.first_frame for part, _, _ in asked]
            of_one_drive = with_shared_objects(on_one_clock(manifests, first_frames))
            joined = _joined(name, asked, of_one_drive, folder)
            finish_data_set(folder, {**joined, "parts_without_view": without})
    except OSError as error:
        raise DataError(f"cannot write {out} ({error.strerror or error}); check space and rights") from error
    return out


def _manifests_of_one_view(parts: Sequence[_Part]) -> list[dict[str, Any]]:
    """The manifests of the parts' data sets.

    Raises:
        DataError: A data set is damaged, or is of another view, recipe or seed than the first.
    """
    for _, _, folder in parts:
        fault = damaged_data_set(folder)
        if fault is not None:
            raise DataError(
                f"{folder}: expected a whole data set, found {fault} damaged; `nvsf verify --mend`"
            )
    manifests = [_manifest(folder) for _, _, folder in parts]
    for (part, _, _), manifest in zip(parts, manifests, strict=True):
        differing = [key for key in _SAME if not _agree(manifest.get(key), manifests[0].get(key))]
        if not _agree(_asked(manifest), _asked(manifests[0])):
            differing.append("view")
        if differing:
            raise DataError(
                f"{part.name}: expected the {differing[0]} of {parts[0][0].name}, found another; make all "
                "parts' data sets of one view, by one recipe and seed"
            )
    return manifests


def _asked(manifest: dict[str, Any]) -> dict[str, Any]:
    """What a part's view asks for, but for its frames, which are the part's own."""
    return {key: value for key, value in asked_of(manifest).items() if key != "frames"}


def _agree(one: Any, other: Any) -> bool:
    """Whether entries are the same but for rounding: each part places cameras in a frame of its own."""
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(_agree(one[key], other[key]) for key in one)
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(_agree, one, other))
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other, rel_tol=_ROUNDING, abs_tol=_ROUNDING)
    return bool(one == other)


def _joined(
    name: str, parts: Sequence[_Part], manifests: Sequence[dict[str, Any]], out: Path
) -> dict[str, Any]:
    """Copy the files; the manifest's entries."""
    rows: dict[str, list[dict[str, Any]]] = {"scans": [], "images": [], "boxes": [], "field_metrics": []}
    left_out: set[str] = set()
    known: set[tuple[int, int | None]] = set()
    objects = _objects(manifests)
    for (part, own, folder), manifest in zip(parts, manifests, strict=True):
        for row in manifest["scans"] + manifest["images"]:
            if row["number"] != row["nearest_frame"]:
                raise DataError(f"{part.name}: expected a view of recorded frames, found one of other times")
        for kind in ("scans", "images"):
            for row in manifest[kind]:
                if row["number"] in own:
                    rows[kind].append(row)
                    for file in _files(row):
                        (out / file).parent.mkdir(parents=True, exist_ok=True)
                        shutil.copyfile(folder / file, out / file)
                    if "instance" in row:
                        values = read_numbers(folder / row["instance"])
                        write_grey(out / row["instance"], _renumbered(manifest, objects)[values], np.uint16)
        for box in manifest["boxes"]:
            key = (box["object_id"], box["number"])
            if key not in known and (box["number"] is None or box["number"] in own):
                known.add(key)
                rows["boxes"].append(box)
        rows["field_metrics"] += manifest["field_metrics"]
        left_out |= {path.name for path in folder.iterdir() if path.name in WHOLE}
    version = "joined-" + "-".join(one["version"].rpartition("-")[2] for one in manifests)[:60]
    not_common = {*_OF_ITS_MODEL, "camera_names"}  # whole formats, which have them, are not joined
    common = {key: value for key, value in manifests[0].items() if key not in not_common}
    return {
        **common, **rows, "scene": name, "version": version,
        "view": _view(manifests), **{key: _in_common(manifests, key) for key in ("rendering", "drawn")},
        "source_checksums": {k: v for one in manifests for k, v in one["source_checksums"].items()},
        "instances": [{**row, "value": value} for value, row in enumerate(objects, start=1)],
        "field_metrics": _means(name, rows["field_metrics"]),
        "parts": [
            {"scene": part.name, "version": one["version"], "frames": [own[0], own[-1]],
             **{key: one[key] for key in _OF_ITS_MODEL if key in one}}
            for (part, own, _), one in zip(parts, manifests, strict=True)
        ],
        "not_joined": sorted(left_out),
    }  # fmt: skip


def _view(manifests: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The view as the drive asks for it: of all parts' frames."""
    frames = [one["view"].get("frames", "all") for one in manifests]
    union = "all" if "all" in frames else sorted({number for some in frames for number in some})
    return {**manifests[0]["view"], "frames": union}


def _in_common(manifests: Sequence[dict[str, Any]], key: str) -> dict[str, Any]:
    """Facts of an entry that hold for all parts; their scenes' frames, noise and costs are their own."""
    first, *others = (one.get(key, {}) for one in manifests)
    return {
        name: value for name, value in first.items() if all(_agree(value, one.get(name)) for one in others)
    }


def _files(row: dict[str, Any]) -> list[str]:
    """The files of a scan's or an image's row that are copied as they are."""
    if "files" in row:
        return [*row["files"].values()]
    return [row[kind] for kind in ("file", "depth", "support") if kind in row]


def _objects(manifests: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The objects of all parts' instance images, each once, by number."""
    found = {row["object_id"]: row for one in manifests for row in one["instances"]}
    return [found[number] for number in sorted(found)]


def _renumbered(manifest: dict[str, Any], objects: Sequence[dict[str, Any]]) -> np.ndarray:
    """What each value of a part's instance images becomes, as uint16; 0 stays 0."""
    value_of = {row["object_id"]: value for value, row in enumerate(objects, start=1)}
    table = np.zeros(len(manifest["instances"]) + 1, np.uint16)
    for row in manifest["instances"]:
        table[row["value"]] = value_of[row["object_id"]]
    return table


def _means(name: str, rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Means over the parts, weighed by the frames that each is defined in."""
    grouped: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in rows:
        key = tuple(value for column, value in row.items() if column not in _OF_A_PART)
        grouped.setdefault(key, []).append(row)
    found = []
    for group in grouped.values():
        means = {
            column: _mean([(row.get(column), row[count]) for row in group])
            for column, count in (("value", "n_defined"), ("render_seconds", "n_frames"))
        }
        sums = {column: _sum([row.get(column) for row in group]) for column in (*_COUNTS, *_COSTS)}
        found.append({**group[0], "scene": name, **means, **sums})
    return found


def _mean(weighed: Sequence[tuple[float | str | None, int]]) -> float | str | None:
    """The mean of stored numbers by their weights, as it is stored; an infinite one makes it infinite."""
    known = [(number_of(value), weight) for value, weight in weighed if value is not None and weight > 0]
    count = sum(weight for _, weight in known)
    return stored_number(sum(value * weight for value, weight in known) / count) if count else None


def _sum(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) if known else None


def asks_for(part: SceneEntry, view: str) -> bool:
    """Whether a part has frames of a view of the drive; `view` is its name, or `test`."""
    return bool(part.test_frames) if view == HELD_OUT else view in [one.name for one in part.views]


def newest_data_set(home: Path, scene: str, view: str, recipe: str | None, seed: int) -> Path:
    """The newest published data set of a view.

    Args:
        home: Folder of all outputs.
        scene: The part.
        view: Name of the view.
        recipe: A preset's name; None = any.
        seed: Of training.

    Raises:
        DataError: There is none.
    """
    for version in reversed(in_order(SceneStore(home, scene), view)):
        if not (version.folder / MANIFEST_NAME).is_file():
            continue
        manifest = _manifest(version.folder)
        if manifest["seed"] == seed and recipe in (None, manifest["recipe"]["name"]):
            return version.folder
    raise DataError(
        f"expected a data set of view {view!r} of scene {scene}, recipe {recipe or 'any'}, seed {seed}, "
        f"below {home}, found none; `nvsf train {scene}` makes it"
    )


def _manifest(folder: Path) -> dict[str, Any]:
    try:
        manifest: dict[str, Any] = json.loads((folder / MANIFEST_NAME).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DataError(f"{folder}: expected a data set with {MANIFEST_NAME} ({error})") from error
    for own in ("checksums", SEAL):
        manifest.pop(own, None)
    return manifest
