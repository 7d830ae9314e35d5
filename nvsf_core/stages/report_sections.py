"""The scenes' sections of the report: one of which nothing has changed is taken over from the report before.

Pictures and pages of a scene take seconds to make. With many scenes in a home, a training of one of them
would wait for all others.
"""

import os
import re
import shutil
from collections.abc import Sequence
from pathlib import Path

from nvsf_core.errors import NvsfError
from nvsf_core.reporting.report import scene_section
from nvsf_core.reporting.scene_outputs import SceneOutputs, collect_scene
from nvsf_core.reporting.view_files import PAGES, with_view_files
from nvsf_core.stages.scene_records import stage_records
from nvsf_core.stores.scene_store import SceneStore

_SECTIONS = "sections"


def section_of(
    folder: Path,
    earlier: Path,
    home: Path,
    name: str,
    failure: str | None,
    source: str | None,
) -> tuple[SceneOutputs, str]:
    """A scene's outputs and its section, whose files are written into the folder of the new report.

    Args:
        folder: The new report.
        earlier: The report before; may be absent.
        home: NVSF_HOME.
        name: The scene.
        failure: Why its last run failed; None if it did not.
        source: Digest of all that the section is made from; None = it is not kept.
    """
    if source is None:
        return scene_section(with_view_files(folder, home, _collected(home, name, failure)))
    kept = _kept(earlier, name, source)
    if kept is not None:
        scene = _collected(home, name, failure, with_pictures=False)
        _take_over(earlier, folder, _pages_of(kept, name))
    else:
        scene, kept = scene_section(with_view_files(folder, home, _collected(home, name, failure)))
        if not _is_whole(scene):
            return scene, kept
    path = folder / _SECTIONS / f"{name}.html"
    path.parent.mkdir(exist_ok=True)
    path.write_text(f"{_first_line(source)}{kept}", encoding="utf-8", errors="backslashreplace")
    return scene, kept


def _kept(earlier: Path, name: str, source: str) -> str | None:
    """The section in the report before, if it was made from the same and its pages are there."""
    path = earlier / _SECTIONS / f"{name}.html"
    try:
        text = path.read_text(encoding="utf-8") if path.is_file() else ""
    except (OSError, UnicodeDecodeError):
        return None
    section = text.removeprefix(_first_line(source))
    is_there = section != text and all((earlier / page).is_file() for page in _pages_of(section, name))
    return section if is_there else None


def _is_whole(scene: SceneOutputs) -> bool:
    """Whether all that was asked for is shown: what could not be read may be mended, and no record tells."""
    return not scene.failure and not any(one.note for run in scene.runs for one in run.pictures)


def _pages_of(section: str, name: str) -> list[str]:
    """The pages that a scene's section links to, by their places in the report's folder."""
    return re.findall(rf'href="({PAGES}/{re.escape(name)}/[^"/]+)"', section)


def _first_line(source: str) -> str:
    return f"<!-- {source} -->\n"


def _take_over(earlier: Path, folder: Path, pages: Sequence[str]) -> None:
    """Link pages of the report before, or copy them where the disk knows no links."""
    for page in pages:
        target = folder / page
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            os.link(earlier / page, target)
        except OSError:
            shutil.copyfile(earlier / page, target)


def _collected(home: Path, name: str, failure: str | None, *, with_pictures: bool = True) -> SceneOutputs:
    """A scene's outputs; if they are damaged or of earlier code, only that reason."""
    try:
        records = stage_records(SceneStore(home, name).root)
        return collect_scene(home, name, records, failure, with_pictures=with_pictures)
    # Any error may be raised here, and no scene's stored data may prevent the report of the others.
    except Exception as error:
        fault = f"what was published cannot be read: {error if isinstance(error, NvsfError) else repr(error)}"
        return SceneOutputs(name=name, failure=f"{failure}; {fault}" if failure else fault)
