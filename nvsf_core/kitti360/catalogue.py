"""The scene catalogue: which drives there are and which synthetic views are asked for."""

import math
import os
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from nvsf_core.errors import DataError
from nvsf_core.kitti360.layout import CAMERAS, DriveLayout


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewEntry:
    """A synthetic data set that is asked for: `[[view]]` of a catalogue."""

    name: str
    """Name of the view; its folder and its `split` in metric tables."""
    scenes: tuple[str, ...] | None = None
    """Scenes that it is asked of; None = all."""
    sensor: str | None = None
    """Name of a sensor table (`HDL-64E`, `VLP-16`, `OS1-128`); None = the recorded one."""
    shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Forward, left, up, in the vehicle's (LiDAR's) frame."""
    yaw_deg: float = 0.0
    """Turn to the left about the LiDAR's z axis."""
    frames: str | tuple[float, ...] = "all"
    """`all`, frame numbers, or (with `times_s`) nothing."""
    times_s: tuple[float, ...] | None = None
    """Times in seconds of the drive, between frames; None = use `frames`."""
    exports: tuple[str, ...] = ("bin", "ply")
    """File formats that `dataset` writes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneEntry:
    """One drive section: `[[scene]]` of a catalogue."""

    name: str
    """Partition key."""
    root: Path
    """KITTI-360 root that holds `data_3d_raw`, `data_2d_raw`, `data_poses`, `calibration`."""
    sequence: str
    """For example `2013_05_28_drive_0000_sync`."""
    first_frame: int
    """First frame number, inclusive."""
    last_frame: int
    """Last frame number, inclusive."""
    test_frames: tuple[int, ...]
    """Held-out frames: never trained on, never used to choose anything."""
    sweep_period_s: float | None = None
    """Seconds of one LiDAR turn where timestamps are absent; recorded as assumed."""
    cameras: tuple[str, ...] | None = None
    """Cameras to use; None = every camera present and calibrated."""
    recipe: str | None = None
    """Recipe where none is asked for."""
    compensate: bool = True
    """Whether each return is put at its own time; False puts a whole turn at its pose's, as papers do."""
    views: tuple[ViewEntry, ...] = ()
    """The views that apply to this scene."""


UNSET_ROOT = Path("$NVSF_KITTI360_ROOT")
"""Root of an entry that names none while the variable is not set: it exists nowhere, and says why."""

_HOME_VARIABLE = "$NVSF_HOME"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")
_RESERVED_VIEWS = ("train", "val", "test")
_SCENE_KEYS = frozenset(field.name for field in fields(SceneEntry)) - {"views"}
_NEEDED_SCENE_KEYS = frozenset({"name", "sequence", "first_frame", "last_frame", "test_frames"})
_VIEW_KEYS = frozenset(field.name for field in fields(ViewEntry)) - {"times_s"}


def home_from_environment(environ: Mapping[str, str]) -> Path:
    """NVSF_HOME as an absolute path; default `.nvsf` in the working directory."""
    return Path(environ.get("NVSF_HOME") or ".nvsf").expanduser().absolute()


def catalogue_from_environment(environ: Mapping[str, str]) -> tuple[SceneEntry, ...]:
    """The catalogue that NVSF_SCENES (default: the checkout's `scenes.toml`) and NVSF_KITTI360_ROOT ask for.

    Raises:
        DataError: See `load_catalogue`.
    """
    named = [Path(part) for part in environ.get("NVSF_SCENES", "").split(os.pathsep) if part]
    root = environ.get("NVSF_KITTI360_ROOT")
    default = Path(__file__).resolve().parents[2] / "scenes.toml"
    return load_catalogue(
        named or [default], Path(root).expanduser() if root else None, home=home_from_environment(environ)
    )


def load_catalogue(
    paths: Sequence[Path], kitti360_root: Path | None, *, home: Path | None = None
) -> tuple[SceneEntry, ...]:
    """Read catalogue files; scenes with more frames come first, else in the files' order.

    Args:
        paths: Catalogue files; a view of one may name a scene of another.
        kitti360_root: Where entries without a root are looked for.
        home: What `$NVSF_HOME` in a root means; default `.nvsf` in the working directory.

    Raises:
        DataError: A file is absent or no TOML, a key is unknown, missing or of the wrong kind, a name
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
            views.append((f"{path}: view {raw.get('name')!r}", _view(raw, path)))
    _require_known_scenes(views, scenes)
    ordered = sorted(scenes.values(), key=lambda entry: entry.first_frame - entry.last_frame)
    return tuple(replace(entry, views=_views_of(entry, views)) for entry in ordered)


def has_data(entry: SceneEntry) -> bool:
    """Whether a scan or an image of the section is on this machine."""
    layout = DriveLayout(entry.root, entry.sequence)
    return any(
        layout.scan_path(frame).is_file() or any(layout.image_path(name, frame).is_file() for name in CAMERAS)
        for frame in range(entry.first_frame, entry.last_frame + 1)
    )


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DataError(f"cannot read catalogue {path} ({error.strerror}); correct NVSF_SCENES") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise DataError(f"{path} is no TOML: {error}") from error


def _entries(table: Mapping[str, Any], kind: str, path: Path) -> list[dict[str, Any]]:
    entries = table.get(kind, [])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise DataError(f"{path}: expected `[[{kind}]]` entries, found {entries!r}; double the brackets")
    return entries


def _scene(raw: dict[str, Any], path: Path, kitti360_root: Path | None, home: Path) -> SceneEntry:
    where = f"{path}: scene {raw.get('name')!r}"
    _require_keys(raw, _SCENE_KEYS, _NEEDED_SCENE_KEYS, where)
    first, last = _integer(raw, "first_frame", where), _integer(raw, "last_frame", where)
    test_frames = _list(raw, "test_frames", int, where)
    outside = [frame for frame in test_frames if not first <= frame <= last]
    if first < 0 or last < first or outside or len(set(test_frames)) != len(test_frames):
        raise DataError(
            f"{where}: expected 0 <= first_frame <= last_frame and distinct test_frames between them, "
            f"found {first}..{last} and {list(test_frames)}"
        )
    if len(test_frames) > last - first:
        raise DataError(f"{where}: every frame is a test frame; leave at least one to train on")
    period_s = raw.get("sweep_period_s")
    if period_s is not None and not (_is_number(period_s) and 0.0 < period_s < 10.0):
        raise DataError(f"{where}: sweep_period_s: expected seconds of one turn, found {period_s!r}")
    cameras = _list(raw, "cameras", str, where) if "cameras" in raw else None
    unknown = [name for name in cameras or () if name not in CAMERAS]
    if unknown:
        raise DataError(f"{where}: cameras: expected some of {', '.join(CAMERAS)}, found {unknown}")
    return SceneEntry(
        name=_name(raw, where),
        root=_root(raw, path, kitti360_root, home, where),
        sequence=_string(raw, "sequence", where),
        first_frame=first,
        last_frame=last,
        test_frames=tuple(sorted(test_frames)),
        sweep_period_s=None if period_s is None else float(period_s),
        cameras=cameras,
        recipe=_string(raw, "recipe", where) if "recipe" in raw else None,
        compensate=_boolean(raw, "compensate", where) if "compensate" in raw else True,
    )


def _root(raw: dict[str, Any], path: Path, kitti360_root: Path | None, home: Path, where: str) -> Path:
    if "root" not in raw:
        return UNSET_ROOT if kitti360_root is None else kitti360_root.absolute()
    text = _string(raw, "root", where)
    if text.split("/")[0] == _HOME_VARIABLE:
        return home / text.removeprefix(_HOME_VARIABLE).lstrip("/")
    # joinpath keeps an absolute root as it is.
    return path.absolute().parent.joinpath(Path(text).expanduser())


def _view(raw: dict[str, Any], path: Path) -> ViewEntry:
    where = f"{path}: view {raw.get('name')!r}"
    _require_keys(raw, _VIEW_KEYS, frozenset({"name"}), where)
    name = _name(raw, where)
    if name in _RESERVED_VIEWS:
        raise DataError(f"{where}: {', '.join(_RESERVED_VIEWS)} are splits of recorded frames; rename it")
    shift_m = raw.get("shift_m", [0.0, 0.0, 0.0])
    yaw_deg = raw.get("yaw_deg", 0.0)
    if not (isinstance(shift_m, list) and len(shift_m) == 3 and all(map(_is_number, shift_m))):
        raise DataError(f"{where}: shift_m: expected [forward, left, up] in metres, found {shift_m!r}")
    if not _is_number(yaw_deg):
        raise DataError(f"{where}: yaw_deg: expected degrees, found {yaw_deg!r}")
    frames, times_s = _frames_or_times(raw.get("frames", "all"), where)
    return ViewEntry(
        name=name,
        scenes=_list(raw, "scenes", str, where) if "scenes" in raw else None,
        sensor=_string(raw, "sensor", where) if "sensor" in raw else None,
        shift_m=(float(shift_m[0]), float(shift_m[1]), float(shift_m[2])),
        yaw_deg=float(yaw_deg),
        frames=frames,
        times_s=times_s,
        exports=_list(raw, "exports", str, where) if "exports" in raw else ("bin", "ply"),
    )


def _frames_or_times(value: Any, where: str) -> tuple[str | tuple[float, ...], tuple[float, ...] | None]:
    """`all`, whole numbers (frames), or numbers with a point (seconds of the drive)."""
    if value == "all":
        return "all", None
    if isinstance(value, list) and value and all(_is_number(item) and item >= 0 for item in value):
        if all(isinstance(item, int) for item in value):
            return tuple(value), None
        if all(isinstance(item, float) for item in value):
            return (), tuple(value)
    raise DataError(
        f'{where}: frames: expected "all", frame numbers [3, 4], or seconds [0.35, 0.45], found {value!r}'
    )


def _require_known_scenes(views: Iterable[tuple[str, ViewEntry]], scenes: Mapping[str, SceneEntry]) -> None:
    for where, view in views:
        for name in view.scenes or ():
            if name not in scenes:
                raise DataError(f"{where}: unknown scene {name!r}; the catalogue has {', '.join(scenes)}")
            first, last = scenes[name].first_frame, scenes[name].last_frame
            if view.times_s is None and view.frames != "all":
                outside = [frame for frame in view.frames if not first <= float(frame) <= last]
                if outside:
                    raise DataError(f"{where}: frames {outside} are not in {first}..{last} of scene {name}")


def _views_of(entry: SceneEntry, views: Iterable[tuple[str, ViewEntry]]) -> tuple[ViewEntry, ...]:
    chosen: dict[str, ViewEntry] = {}
    for where, view in views:
        if view.scenes is None or entry.name in view.scenes:
            if view.name in chosen:
                raise DataError(f"{where}: scene {entry.name} has a view of this name already; rename one")
            chosen[view.name] = view
    return tuple(chosen.values())


def _require_keys(raw: Mapping[str, Any], known: frozenset[str], needed: frozenset[str], where: str) -> None:
    unknown, missing = sorted(raw.keys() - known), sorted(needed - raw.keys())
    if unknown:
        raise DataError(f"{where}: unknown keys {', '.join(unknown)}; known are {', '.join(sorted(known))}")
    if missing:
        raise DataError(f"{where}: missing keys {', '.join(missing)}")


def _name(raw: Mapping[str, Any], where: str) -> str:
    name = _string(raw, "name", where)
    if not _NAME.fullmatch(name):
        raise DataError(f"{where}: a name is a folder and a partition key: only letters, digits, `_.-`")
    return name


def _string(raw: Mapping[str, Any], key: str, where: str) -> str:
    value = raw[key]
    if not isinstance(value, str) or not value:
        raise DataError(f"{where}: {key}: expected text, found {value!r}")
    return value


def _integer(raw: Mapping[str, Any], key: str, where: str) -> int:
    value = raw[key]
    if not isinstance(value, int) or isinstance(value, bool):
        raise DataError(f"{where}: {key}: expected a whole number, found {value!r}")
    return value


def _boolean(raw: Mapping[str, Any], key: str, where: str) -> bool:
    value = raw[key]
    if not isinstance(value, bool):
        raise DataError(f"{where}: {key}: expected true or false, found {value!r}")
    return value


def _list(raw: Mapping[str, Any], key: str, kind: type, where: str) -> tuple[Any, ...]:
    value = raw[key]
    if not isinstance(value, list) or not all(type(item) is kind for item in value):
        raise DataError(f"{where}: {key}: expected a list of {kind.__name__}, found {value!r}")
    return tuple(value)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
