"""`benchmark_report`: one offline HTML page over all scenes. It is no `Stage`: a stage runs on one scene."""

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path

from nvsf_core import metrics, reporting
from nvsf_core.errors import StoreError
from nvsf_core.names import RESERVED_SCENES, name_fault
from nvsf_core.reporting.report import write_report
from nvsf_core.reporting.scene_outputs import measured_scenes
from nvsf_core.reporting.speed_plots import speed_section
from nvsf_core.stages import STAGE_NAMES
from nvsf_core.stages.report_sections import section_of
from nvsf_core.stages.runner.failures import remembered_failures
from nvsf_core.stages.runner.locks import LOCKS, file_lock
from nvsf_core.stages.scene_records import RECORDS
from nvsf_core.stages.versions_page import made_from, write_versions_page
from nvsf_core.stores.scene_store import publish_folder, published

_PAGE, _SOURCE = "index.html", "made_from.sha256"
_REPORTING, _METRICS = Path(reporting.__file__).parent, Path(metrics.__file__).parent
_CODE = ("*.py", "*.js", "page.html")
_OWN = ("benchmark_report", "report_sections", "scene_records", "versions_page")
"""Modules beside this one of which the page is made."""


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
    no_data = [name for name in no_data if name not in others]
    # Curves of scenes that this home never trained would only look like its own.
    plots = speed_section(curves, {*own, *others})
    try:
        lock = file_lock(home / LOCKS / f"{target.name}.lock", _silent, "another run's report")
        with lock, publish_folder(target) as folder:
            sections = []
            for name in [*own, *others]:
                # One of another name has nothing stored that could be told apart from before.
                made = _source(home, [name], failures.get(name)) if name in stored else None
                sections.append(section_of(folder, target, home, name, failures.get(name), made))
            written = write_report(folder, sections, no_data, plots)
            write_versions_page(folder, home, stored)
            (folder / _SOURCE).write_text(source)
    except OSError as error:
        raise StoreError(
            f"the disk refused {error.filename or target} ({error.strerror or error}); free space, or mend "
            "what is in its place, and make the report again"
        ) from error
    return target / written.name


def _source(home: Path, names: Sequence[str], said: object, curves: Path | None = None) -> str:
    """A digest of all that the page, or the section of one scene, is made from, its own code included."""
    read = [path for name in names for pattern in RECORDS for path in published(home / name, pattern)]
    read += made_from(home, names)
    read += sorted(curves.rglob("*.json")) if curves is not None else []
    code = [path for kind in _CODE for root in (_REPORTING, _METRICS) for path in root.rglob(kind)]
    code += [Path(__file__).with_name(f"{name}.py") for name in _OWN]
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
