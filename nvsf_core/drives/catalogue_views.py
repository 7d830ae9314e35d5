"""Views and sensors as a catalogue's tables give them; the same keys make a view of one's own in Python."""

from collections.abc import Callable, Mapping
from dataclasses import MISSING, fields, replace
from pathlib import Path
from typing import Any, TypeVar

from nvsf_core.drives.pose_files import read_pose_file
from nvsf_core.drives.view_entry import ViewEntry
from nvsf_core.drives.view_parts import CameraEntry, SensorEntry, Waypoint
from nvsf_core.errors import DataError
from nvsf_core.names import RESERVED_VIEWS

HOME_VARIABLE = "$NVSF_HOME"
_LONGEST_TEXT = 1000
"""Longest root: a path's parts may have 255 bytes each."""
_Made = TypeVar("_Made")
_Part = TypeVar("_Part", SensorEntry, CameraEntry, Waypoint)


def read_sensor(raw: Mapping[str, Any], where: str) -> SensorEntry:
    """A `[[sensor]]` of a catalogue.

    Raises:
        DataError: A key is unknown, missing or of the wrong kind; the message begins with `where`.
    """
    return _part(SensorEntry, raw, where)


def read_view(
    raw: Mapping[str, Any], where: str, folder: Path, home: Path, sensors: Mapping[str, SensorEntry]
) -> ViewEntry:
    """A `[[view]]` of a catalogue.

    Args:
        raw: Its keys and values.
        where: File and name, for messages.
        folder: Folder of the catalogue; a `pose_file` lies beside it.
        home: Folder for `$NVSF_HOME` in a path.
        sensors: The catalogue's own sensors by name.

    Raises:
        DataError: A key is unknown or of the wrong kind, or what is asked for is impossible; the message
            begins with `where`.
    """
    require_keys(raw, frozenset(field.name for field in fields(ViewEntry)), frozenset({"name"}), where)
    if raw["name"] in RESERVED_VIEWS:
        raise DataError(f"{where}: {', '.join(RESERVED_VIEWS)} are splits of recorded frames; rename it")
    values: dict[str, Any] = dict(raw) | {"frames": _frames(raw, where), "truth": _truth(raw, home, where)}
    values["waypoints"] = _parts(Waypoint, raw, "waypoints", where)
    values["camera"] = _parts(CameraEntry, raw, "camera", where)
    if isinstance(raw.get("sensor"), str):
        values["sensor"] = sensors.get(raw["sensor"], raw["sensor"])
    if "pose_file" in raw:
        named = folder.absolute() / path_of(raw["pose_file"], home, f"{where}: pose_file")
        values["pose_file"] = _said(where, lambda: read_pose_file(named))
    entry = _said(where, lambda: ViewEntry(**_tuples(values)))
    forward_m, left_m, up_m = map(float, entry.shift_m)
    return replace(entry, shift_m=(forward_m, left_m, up_m), yaw_deg=float(entry.yaw_deg))


def path_of(text: Any, home: Path, what: str) -> Path:
    """A path as a catalogue names it, with `$NVSF_HOME` and `~` replaced; relative ones stay so.

    Raises:
        DataError: It is none; the message begins with `what`.
    """
    if not isinstance(text, str) or not text or not text.isprintable() or len(text) > _LONGEST_TEXT:
        raise DataError(f"{what}: expected 1 to {_LONGEST_TEXT} printable characters, found {text!r:.60}")
    if text.split("/")[0] == HOME_VARIABLE:
        return home / text.removeprefix(HOME_VARIABLE).lstrip("/")
    return expanded(text, what)


def expanded(text: str, what: str) -> Path:
    """A path with a leading `~` or `~user` replaced by the home folder; `what` names it in the message.

    Raises:
        DataError: There is no such user.
    """
    try:
        return Path(text).expanduser()
    except RuntimeError as error:
        raise DataError(f"{what}: expected a path, found {text!r:.100} ({error})") from error


def require_keys(raw: Mapping[str, Any], known: frozenset[str], needed: frozenset[str], where: str) -> None:
    """Refuse unknown and missing keys.

    Raises:
        DataError: There are some; the message begins with `where`.
    """
    unknown, missing = sorted(raw.keys() - known), sorted(needed - raw.keys())
    if unknown:
        raise DataError(
            f"{where}: unknown keys {', '.join(unknown):.200}; known are {', '.join(sorted(known))}"
        )
    if missing:
        raise DataError(f"{where}: missing keys {', '.join(missing)}")


def _frames(raw: Mapping[str, Any], where: str) -> Any:
    """Field `frames` of a view; empty if other keys give its times."""
    if "frames" not in raw:
        return () if "times_s" in raw or "rate_hz" in raw else "all"
    others = [key for key in ("times_s", "rate_hz") if key in raw]
    if others:
        raise DataError(f"{where}: expected `frames` or `{others[0]}`, found both; leave one out")
    frames = raw["frames"]
    if isinstance(frames, list) and any(isinstance(item, float) for item in frames):
        raise DataError(
            f'{where}: frames: expected "all" or frame numbers, as [3, 4], found {frames!r:.60}; moments '
            "between frames are `times_s`, as [0.35, 0.45]: seconds since the scene's first frame"
        )
    return frames


def _truth(raw: Mapping[str, Any], home: Path, where: str) -> tuple[tuple[str, Path], ...]:
    folders = raw.get("truth", {})
    if not isinstance(folders, dict):
        raise DataError(
            f'{where}: truth: expected cameras with their folders, as {{ image_00 = "folder" }}, found '
            f"{folders!r:.60}"
        )
    return tuple((name, path_of(text, home, f"{where}: truth: {name:.60}")) for name, text in folders.items())


def _parts(kind: type[_Part], raw: Mapping[str, Any], key: str, where: str) -> tuple[_Part, ...]:
    items = raw.get(key, [])
    if not isinstance(items, list) or not all(isinstance(item, dict) for item in items):
        raise DataError(f"{where}: {key}: expected a list of tables, found {items!r:.60}")
    return tuple(_part(kind, item, f"{where}: {key} {number}") for number, item in enumerate(items, start=1))


def _part(kind: type[_Part], raw: Mapping[str, Any], where: str) -> _Part:
    known = frozenset(field.name for field in fields(kind))
    needed = frozenset(field.name for field in fields(kind) if field.default is MISSING)
    require_keys(raw, known, needed, where)
    values = dict(raw)
    if isinstance(values.get("mei"), dict):
        values["mei"] = sorted(values["mei"].items())
    return _said(where, lambda: kind(**_tuples(values)))


def _tuples(values: Mapping[str, Any]) -> dict[str, Any]:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in values.items()}


def _said(where: str, make: Callable[[], _Made]) -> _Made:
    """What `make` makes; its error begins with `where`."""
    try:
        return make()
    except DataError as error:
        raise DataError(f"{where}: {error}") from error
