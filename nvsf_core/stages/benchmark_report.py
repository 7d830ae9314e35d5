"""`benchmark_report`: one offline HTML page over all scenes. It is no `Stage`: a stage runs on one scene."""

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path

from nvsf_core import metrics, reporting
from nvsf_core._types import Scalar
from nvsf_core.errors import NvsfError, StoreError
from nvsf_core.names import RESERVED_SCENES, name_fault
from nvsf_core.reporting.report import write_report
from nvsf_core.reporting.scene_outputs import SceneOutputs, collect_scene, measured_scenes
from nvsf_core.reporting.speed_plots import speed_section
from nvsf_core.reporting.stage_record import StageRecord
from nvsf_core.reporting.view_files import with_view_files
from nvsf_core.stages import STAGE_NAMES
from nvsf_core.stages.runner.failures import remembered_failures
from nvsf_core.stages.runner.locks import LOCKS, file_lock
from nvsf_core.stages.runner.record import RECORD_NAME, content_of, made_s, read_record
from nvsf_core.stages.versions import VERSIONS
from nvsf_core.stages.versions_page import made_from, write_versions_page
from nvsf_core.stores.scene_store import SceneStore, publish_folder, published

_PAGE, _SOURCE = "index.html", "made_from.sha256"
_REPORTING, _METRICS = Path(reporting.__file__).parent, Path(metrics.__file__).parent
_CODE = ("*.py", "*.js", "page.html")
_INDEX = ".index"
_RECORDS = (f"*/{RECORD_NAME}", f"*/*/*/{RECORD_NAME}", f"dataset/{_INDEX}/*/*/{RECORD_NAME}")
"""Patterns of stage records below a scene's folder: once per scene, per recipe and seed, per data set."""


def make_benchmark_report(
    home: Path,
    scene_names: Sequence[str],
    failures: Mapping[str, str],
    no_data: Sequence[str],
    curves: Path | None = None,
) -> Path:
    """Make the page from all metrics under `home`, and publish it whole.

    A scene whose outputs cannot be read is listed with the reason; the others are shown all the same.

    Args:
        home: NVSF_HOME.
        scene_names: Scenes of this run, shown first and in this order; then the home's others, by name.
        failures: Scene to the reason why this run of it failed; its earlier outputs are shown. What stages
            failed with in other runs, and have not succeeded since, is shown of all others.
        no_data: Catalogue scenes whose recordings are not on this machine.
        curves: Folder with error over training time by `make bench`, shown for the page's scenes; None = not
            shown.

    Returns:
        Path of `<home>/benchmark_report/index.html`.

    Raises:
        StoreError: The page cannot be written.
    """
    own = list(dict.fromkeys([*scene_names, *failures]))
    failures = remembered_failures(home, STAGE_NAMES) | dict(failures)
    others = [name for name in sorted({*measured_scenes(home), *failures}) if name not in own]
    target = home / "benchmark_report"
    # One of another name has no folder; it is shown with what was said of it.
    stored = [name for name in [*own, *others] if name_fault(name, RESERVED_SCENES) is None]
    source = _source(home, stored, ([*own, *others], failures, list(no_data)), curves)
    if (target / _PAGE).is_file() and _written(target / _SOURCE) == source:
        return target / _PAGE
    scenes = [_collected(home, name, failures.get(name)) for name in [*own, *others]]
    no_data = [name for name in no_data if name not in others]
    # Curves of scenes that this home never trained would only look like its own.
    shown = {scene.name for scene in scenes}
    try:
        lock = file_lock(home / LOCKS / f"{target.name}.lock", _silent, "another run's report")
        with lock, publish_folder(target) as folder:
            scenes = [with_view_files(folder, home, scene) for scene in scenes]
            written = write_report(folder, scenes, no_data, speed_section(curves, shown))
            write_versions_page(folder, home, stored)
            (folder / _SOURCE).write_text(source)
    except OSError as error:
        raise StoreError(
            f"the disk refused {error.filename or target} ({error.strerror or error}); free space, or mend "
            "what is in its place, and make the report again"
        ) from error
    return target / written.name


def _source(home: Path, names: Sequence[str], said: object, curves: Path | None) -> str:
    """A digest of all that the page is made from, its own code included."""
    read = [path for name in names for pattern in _RECORDS for path in published(home / name, pattern)]
    read += made_from(home, names)
    read += sorted(curves.rglob("*.json")) if curves is not None else []
    code = [path for kind in _CODE for root in (_REPORTING, _METRICS) for path in root.rglob(kind)]
    code += [Path(__file__), Path(__file__).with_name("versions_page.py")]
    state = [one for path in [*read, *code] for one in _state_of(path)]
    return hashlib.sha256(repr((list(names), said, sorted(state))).encode()).hexdigest()


def _state_of(path: Path) -> list[tuple[str, int, int]]:
    """Name, time and size of a file; nothing of one that is being replaced."""
    try:
        found = path.stat()
    except FileNotFoundError:
        return []
    return [(str(path), found.st_mtime_ns, found.st_size)]


def _silent(line: str) -> None:
    """A page takes seconds: who waits for one needs no words."""


def _written(path: Path) -> str | None:
    try:
        return path.read_text()
    except (OSError, UnicodeDecodeError):
        return None


def _collected(home: Path, name: str, failure: str | None) -> SceneOutputs:
    """A scene's outputs; if they are damaged or of earlier code, only that reason."""
    try:
        return collect_scene(home, name, stage_records(SceneStore(home, name).root), failure)
    # Any error may be raised here, and no scene's stored data may prevent the report of the others.
    except Exception as error:
        fault = f"what was published cannot be read: {error if isinstance(error, NvsfError) else repr(error)}"
        return SceneOutputs(name=name, failure=f"{failure}; {fault}" if failure else fault)


def stage_records(root: Path) -> list[StageRecord]:
    """The stages' records in the order of the flow; of data sets only the newest of each recipe and seed."""
    found: dict[str, tuple[float, Path]] = {}
    for pattern in _RECORDS:
        for path in published(root, pattern):
            name = _name_of(path.parent.relative_to(root).parts)
            made = made_s(path.parent)
            if name not in found or found[name][0] < made:
                found[name] = (made, path.parent)
    records = []
    for name in sorted(found, key=_flow_rank):
        record = read_record(found[name][1])
        if record is not None:
            shown = {key: record[key] for key in ("seconds", "metadata", "checks", "facts", "made_s")}
            shown["metadata"] = _without_removed(root, name, record["metadata"])
            records.append(StageRecord(stage=name, content=content_of(record), **shown))
    return records


def _name_of(parts: tuple[str, ...]) -> str:
    """A record's stage and, of one that is run per recipe, recipe and seed; by the parts of its place."""
    if parts[1:2] == (_INDEX,):
        stage, _, recipe, sampled = parts  # seed, seed of drawing and label
        return f"{stage} {recipe} {sampled.partition('-')[0]}"
    return " ".join(parts)


def _without_removed(root: Path, name: str, metadata: Mapping[str, Scalar]) -> dict[str, Scalar]:
    """A record's numbers; of data sets without the versions that were removed, to which no link leads."""
    ending = "_version"
    return {
        key: value
        for key, value in metadata.items()
        if not (name.startswith(VERSIONS) and key.endswith(ending))
        or (root / VERSIONS / key.removesuffix(ending) / str(value)).is_dir()
    }


def _flow_rank(name: str) -> tuple[int, str]:
    stage = name.split(" ")[0]
    return (STAGE_NAMES.index(stage) if stage in STAGE_NAMES else len(STAGE_NAMES), name)
