"""Reading of the scene catalogue: sections of recorded drives, and the synthetic views to make of them."""

import os
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, TypeVar

from nvsf_core.drives.entries import SceneEntry, ViewEntry
from nvsf_core.drives.kitti360.layout import CAMERAS, DriveLayout
from nvsf_core.drives.kitti360.text import MIB, read_text
from nvsf_core.drives.kitti360.timestamps import frame_times
from nvsf_core.errors import DataError
from nvsf_core.names import RESERVED_VIEWS

__all__ = [
    "UNSET_ROOT",
    "SceneEntry",
    "ViewEntry",
    "catalogue_from_environment",
    "has_data",
    "home_from_environment",
    "load_catalogue",
    "require_times_in_drive",
]

UNSET_ROOT = Path("$NVSF_KITTI360_ROOT")
"""Root of a scene without one if the variable is not set: it does not exist, and its name says why."""

_HOME_VARIABLE = "$NVSF_HOME"
_MOST_BYTES = MIB
"""Largest catalogue file: some ten thousand scenes."""
_LONGEST_TEXT = 1000
"""Longest root: a path's parts may have 255 bytes each."""
_MOST_DOTS = 20
_MOST_VIEWS = 1000
_SLACK_S = 1e-6
"""Times may lie outside the drive by this rounding error."""
_SCENE_KEYS = frozenset(field.name for field in fields(SceneEntry)) - {"views"}
_NEEDED_SCENE_KEYS = frozenset({"name", "sequence", "first_frame", "last_frame", "test_frames"})
_VIEW_KEYS = frozenset(field.name for field in fields(ViewEntry))
_Entry = TypeVar("_Entry", SceneEntry, ViewEntry)


def home_from_environment(environ: Mapping[str, str]) -> Path:
    """NVSF_HOME as an absolute path; default `.nvsf` in the working directory."""
    return _expanded(environ.get("NVSF_HOME") or ".nvsf", "NVSF_HOME").absolute()


def catalogue_from_environment(environ: Mapping[str, str]) -> tuple[SceneEntry, ...]:
    """The catalogue given by NVSF_SCENES (default: the project's `scenes.toml`) and NVSF_KITTI360_ROOT.

    Raises:
        DataError: See `load_catalogue`.
    """
    parts = environ.get("NVSF_SCENES", "").split(os.pathsep)
    named = [_expanded(part, "NVSF_SCENES") for part in parts if part]
    root = environ.get("NVSF_KITTI360_ROOT")
    return load_catalogue(
        named or [_own_catalogue()],
        _expanded(root, "NVSF_KITTI360_ROOT") if root else None,
        home=home_from_environment(environ),
    )


def _own_catalogue() -> Path:
    """The project's catalogue: beside the package in a checkout, in the package where it was installed."""
    package = Path(__file__).resolve().parents[1]
    beside = package.parent / "scenes.toml"
    return beside if (package.parent / "pyproject.toml").is_file() else package / "scenes.toml"


def _expanded(text: str, what: str) -> Path:
    """A path with a leading `~` or `~user` replaced by the home folder; `what` names it in the message."""
    try:
        return Path(text).expanduser()
    except RuntimeError as error:
        raise DataError(f"{what}: expected a path, found {text!r:.100} ({error})") from error


def load_catalogue(
    paths: Sequence[Path], kitti360_root: Path | None, *, home: Path | None = None
) -> tuple[SceneEntry, ...]:
    """Read catalogue files into scenes, longest first, else in the files' order.

    Args:
        paths: Catalogue files; a view of one may name a scene of another.
        kitti360_root: KITTI-360 root of scenes that give none; None = `UNSET_ROOT`.
        home: Folder for `$NVSF_HOME` in a folder's path; None = `.nvsf` in the working directory.

    Raises:
        DataError: A file is absent or not TOML, a key is unknown, missing or of the wrong kind, a name
            is given twice, or frames do not fit; the message names file, entry and key.
    """
    scenes: dict[str, SceneEntry] = {}
    views: list[tuple[str, ViewEntry]] = []
    for path in paths:
        table = _read_toml(path)
        _require_keys(table, frozenset({"scene", "view"}), frozenset(), f"{path}")
        for raw in _entries(table, "scene", path):
            entry = _scene(raw, path, kitti360_root, home or home_from_environment({}))
            if entry.name in scenes:
                raise DataError(f"{path}: scene {entry.name!r} is given twice; rename one")
            scenes[entry.name] = entry
        for raw in _entries(table, "view", path):
            view = _view(raw, path, home or home_from_environment({}))
            views.append((f"{path}: view {raw.get('name')!r:.60}", view))
    if not scenes:
        raise DataError(
            f"{', '.join(map(str, paths)):.300}: expected at least one `[[scene]]`, found none; add one"
        )
    if len(views) > _MOST_VIEWS:
        raise DataError(f"{paths[0]}: expected at most {_MOST_VIEWS} views in all, found {len(views)}")
    for where, view in views:
        for name in view.scenes or ():
            if name not in scenes:
                raise DataError(f"{where}: unknown scene {name!r}; the catalogue has {', '.join(scenes)}")
    _require_other_names(scenes)
    ordered = sorted(scenes.values(), key=lambda entry: entry.first_frame - entry.last_frame)
    try:
        return tuple(
            replace(entry, views=tuple(one for _, one in views if entry.name in (one.scenes or scenes)))
            for entry in ordered
        )
    except DataError as error:
        raise DataError(f"{', '.join(map(str, paths)):.300}: {error}") from error


def has_data(entry: SceneEntry) -> bool:
    """Whether a scan or an image of the scene is on this machine.

    Raises:
        DataError: The folders cannot be read.
    """
    layout = DriveLayout(entry.root, entry.sequence)
    try:
        return any(
            layout.scan_path(frame).is_file()
            or any(layout.image_path(name, frame).is_file() for name in CAMERAS)
            for frame in range(entry.first_frame, entry.last_frame + 1)
        )
    except OSError as error:
        raise DataError(
            f"scene {entry.name}: cannot look into {error.filename or entry.root} ({error.strerror}); "
            "correct its root, or its permissions"
        ) from error


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        text = read_text(path, _MOST_BYTES)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise DataError(f"cannot read catalogue {path} ({reason}); correct NVSF_SCENES") from error
    if _is_nested(text):
        raise DataError(
            f"{path} is no TOML of a catalogue: a key has more than {_MOST_DOTS} parts; shorten it"
        )
    try:
        return tomllib.loads(text)
    # A number of 5000 digits raises a ValueError, as deeply nested brackets a RecursionError.
    except (ValueError, RecursionError) as error:
        reason = error if isinstance(error, tomllib.TOMLDecodeError) else "absurd numbers or nesting"
        raise DataError(f"{path} is no TOML: {reason!s:.300}; correct the file") from error


def _is_nested(text: str) -> bool:
    """Whether a key has too many parts: reading `a.a.a. ... = 1` takes gigabytes."""
    for line in text.splitlines():
        *before, last = line.split("=")
        # A key ends at each `=`, in inline tables too; a line without `=` is a header, or not TOML.
        keys = [re.split(r"[,{\[]", part)[-1] for part in before] or [last.partition(",")[0]]
        if any(key.count(".") > _MOST_DOTS for key in keys):
            return True
    return False


def _entries(table: Mapping[str, Any], kind: str, path: Path) -> list[dict[str, Any]]:
    entries = table.get(kind, [])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise DataError(f"{path}: expected `[[{kind}]]` entries, found {entries!r:.60}; double the brackets")
    return entries


def _scene(raw: dict[str, Any], path: Path, kitti360_root: Path | None, home: Path) -> SceneEntry:
    where = f"{path}: scene {raw.get('name')!r:.60}"
    _require_keys(raw, _SCENE_KEYS, _NEEDED_SCENE_KEYS, where)
    entry = _made(SceneEntry, raw | {"root": _root(raw, path, kitti360_root, home, where)}, where)
    period_s = None if entry.sweep_period_s is None else float(entry.sweep_period_s)
    return replace(entry, test_frames=tuple(sorted(entry.test_frames)), sweep_period_s=period_s)


def _made(kind: type[_Entry], raw: Mapping[str, Any], where: str) -> _Entry:
    """An entry from values as TOML has them; the entry checks their kinds."""
    values: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value for key, value in raw.items()
    }
    try:
        return kind(**values)
    except DataError as error:
        raise DataError(f"{where}: {error}") from error


def _root(raw: dict[str, Any], path: Path, kitti360_root: Path | None, home: Path, where: str) -> Path:
    if "root" not in raw:
        return UNSET_ROOT if kitti360_root is None else kitti360_root.absolute()
    # joinpath keeps an absolute root as it is.
    return path.absolute().parent.joinpath(_folder(raw["root"], home, f"{where}: root"))


def _folder(text: Any, home: Path, what: str) -> Path:
    """A folder as a catalogue names it, with `$NVSF_HOME` and `~` replaced; relative ones stay so."""
    if not isinstance(text, str) or not text or not text.isprintable() or len(text) > _LONGEST_TEXT:
        raise DataError(f"{what}: expected 1 to {_LONGEST_TEXT} printable characters, found {text!r:.60}")
    if text.split("/")[0] == _HOME_VARIABLE:
        return home / text.removeprefix(_HOME_VARIABLE).lstrip("/")
    return _expanded(text, what)


def _truth(raw: Mapping[str, Any], home: Path, where: str) -> tuple[tuple[str, Path], ...]:
    folders = raw.get("truth", {})
    if not isinstance(folders, dict):
        raise DataError(
            f'{where}: truth: expected cameras with their folders, as {{ image_00 = "folder" }}, found '
            f"{folders!r:.60}"
        )
    return tuple((name, _folder(text, home, f"{where}: truth: {name:.60}")) for name, text in folders.items())


def _view(raw: dict[str, Any], path: Path, home: Path) -> ViewEntry:
    where = f"{path}: view {raw.get('name')!r:.60}"
    _require_keys(raw, _VIEW_KEYS, frozenset({"name"}), where)
    if raw["name"] in RESERVED_VIEWS:
        raise DataError(f"{where}: {', '.join(RESERVED_VIEWS)} are splits of recorded frames; rename it")
    truth = _truth(raw, home, where)
    entry = _made(ViewEntry, raw | _frames_and_times(raw, where) | {"truth": truth}, where)
    forward_m, left_m, up_m = map(float, entry.shift_m)
    return replace(entry, shift_m=(forward_m, left_m, up_m), yaw_deg=float(entry.yaw_deg))


def _frames_and_times(raw: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Fields `frames` and `times_s` of a view from its keys of the same names, of which one may be given."""
    frames = raw.get("frames", "all")
    if isinstance(frames, list) and any(isinstance(item, float) for item in frames):
        raise DataError(
            f'{where}: frames: expected "all" or frame numbers, as [3, 4], found {frames!r:.60}; moments '
            "between frames are `times_s`, as [0.35, 0.45]: seconds since the scene's first frame"
        )
    if "times_s" not in raw:
        return {"frames": frames}
    if "frames" in raw:
        raise DataError(f"{where}: expected `frames` or `times_s`, found both; leave one out")
    return {"frames": ()}


def _require_other_names(scenes: Mapping[str, SceneEntry]) -> None:
    """Refuse names that differ only in case: on some disks they are one folder."""
    known: dict[str, str] = {}
    for name in scenes:
        other = known.setdefault(name.casefold(), name)
        if other != name:
            raise DataError(f"scenes {other!r} and {name!r} differ in case alone; rename one")


def _require_keys(raw: Mapping[str, Any], known: frozenset[str], needed: frozenset[str], where: str) -> None:
    unknown, missing = sorted(raw.keys() - known), sorted(needed - raw.keys())
    if unknown:
        raise DataError(
            f"{where}: unknown keys {', '.join(unknown):.200}; known are {', '.join(sorted(known))}"
        )
    if missing:
        raise DataError(f"{where}: missing keys {', '.join(missing)}")


def require_times_in_drive(scene: SceneEntry) -> None:
    """Refuse a view at a time before the scene's first frame or after its last.

    Raises:
        DataError: There is such a view; the message names it, its times and those of the drive.
    """
    timed = [view for view in scene.views if view.times_s is not None or view.frozen_at_s is not None]
    if not timed:
        return
    try:
        layout = DriveLayout(scene.root, scene.sequence)
        times = frame_times(layout, scene.first_frame, scene.last_frame, scene.sweep_period_s)
    except (DataError, OSError):
        return  # the stage `frames` reports what is wrong with the drive
    end_s = float(times.time_s[-1])
    for view in timed:
        asked = [*(view.times_s or ()), *(() if view.frozen_at_s is None else [view.frozen_at_s])]
        outside = [time_s for time_s in asked if not -_SLACK_S <= time_s <= end_s + _SLACK_S]
        if outside:
            raise DataError(
                f"scene {scene.name}, view {view.name}: expected times from 0 to {end_s:g} seconds "
                f"({len(times.time_s)} frames, {times.source}), found {outside!s:.200}; frame numbers "
                "are asked for by `frames`"
            )
