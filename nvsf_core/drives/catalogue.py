"""Reading of the scene catalogue: sections of recorded drives, and the synthetic views to make of them."""

import os
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from nvsf_core.drives.catalogue_views import expanded, path_of, read_sensor, read_view, require_keys
from nvsf_core.drives.cuts import cut_scene
from nvsf_core.drives.entries import OWN_ROOT_KINDS, SceneEntry, ViewEntry
from nvsf_core.drives.kitti360.text import MIB, read_text
from nvsf_core.drives.view_parts import SensorEntry
from nvsf_core.errors import CatalogueError, DataError

__all__ = [
    "UNSET_ROOT",
    "SceneEntry",
    "ViewEntry",
    "catalogue_from_environment",
    "home_from_environment",
    "load_catalogue",
    "sensors_from_environment",
]

UNSET_ROOT = Path("$NVSF_KITTI360_ROOT")
"""Root of a scene without one if the variable is not set: it does not exist, and its name says why."""

_MOST_BYTES = MIB
"""Largest catalogue file: some ten thousand scenes."""
_MOST_DOTS = 20
_MOST_VIEWS = 1000
_SCENE_KEYS = frozenset(field.name for field in fields(SceneEntry)) - {"views"}
_NEEDED_SCENE_KEYS = frozenset({"name", "first_frame", "last_frame", "test_frames"})


def home_from_environment(environ: Mapping[str, str]) -> Path:
    """NVSF_HOME as an absolute path; default `.nvsf` in the working directory."""
    return expanded(environ.get("NVSF_HOME") or ".nvsf", "NVSF_HOME").absolute()


def catalogue_from_environment(environ: Mapping[str, str]) -> tuple[SceneEntry, ...]:
    """The catalogue given by NVSF_SCENES (default: the project's `scenes.toml`) and NVSF_KITTI360_ROOT.

    Raises:
        CatalogueError: See `load_catalogue`.
    """
    root = environ.get("NVSF_KITTI360_ROOT")
    try:
        return load_catalogue(
            _files(environ),
            expanded(root, "NVSF_KITTI360_ROOT") if root else None,
            home=home_from_environment(environ),
        )
    except DataError as error:
        raise CatalogueError(str(error)) from error


def sensors_from_environment(environ: Mapping[str, str]) -> dict[str, SensorEntry]:
    """The `[[sensor]]` entries of the catalogue that NVSF_SCENES gives, by name.

    Raises:
        DataError: See `load_catalogue`.
    """
    found: dict[str, SensorEntry] = {}
    for path in _files(environ):
        _add_sensors(found, _read_toml(path), path)
    return found


def _files(environ: Mapping[str, str]) -> list[Path]:
    parts = environ.get("NVSF_SCENES", "").split(os.pathsep)
    return [expanded(part, "NVSF_SCENES") for part in parts if part] or [_own_catalogue()]


def _own_catalogue() -> Path:
    """The project's catalogue: beside the package in a checkout, in the package where it was installed."""
    package = Path(__file__).resolve().parents[1]
    beside = package.parent / "scenes.toml"
    return beside if (package.parent / "pyproject.toml").is_file() else package / "scenes.toml"


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
    asked: list[tuple[dict[str, Any], Path]] = []
    sensors: dict[str, SensorEntry] = {}
    home = home or home_from_environment({})
    for path in paths:
        table = _read_toml(path)
        require_keys(table, frozenset({"scene", "view", "sensor"}), frozenset(), f"{path}")
        for raw in _entries(table, "scene", path):
            entry = _scene(raw, path, kitti360_root, home)
            if entry.name in scenes:
                raise DataError(f"{path}: scene {entry.name!r} is given twice; rename one")
            scenes[entry.name] = entry
        _add_sensors(sensors, table, path)
        asked += [(raw, path) for raw in _entries(table, "view", path)]
    views = []
    for raw, path in asked:
        where = f"{path}: view {raw.get('name')!r:.60}"
        views.append((where, read_view(raw, where, path.parent, home, sensors)))
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
        whole = [
            replace(entry, views=tuple(one for _, one in views if entry.name in (one.scenes or scenes)))
            for entry in ordered
        ]
        parts = tuple(part for entry in whole for part in cut_scene(entry))
        _require_other_names({part.name: part for part in parts}, len(parts))
        return parts
    except DataError as error:
        raise DataError(f"{', '.join(map(str, paths)):.300}: {error}") from error


def _add_sensors(sensors: dict[str, SensorEntry], table: Mapping[str, Any], path: Path) -> None:
    for raw in _entries(table, "sensor", path):
        sensor = read_sensor(raw, f"{path}: sensor {raw.get('name')!r:.60}")
        if sensor.name in sensors:
            raise DataError(f"{path}: sensor {sensor.name!r} is given twice; rename one")
        sensors[sensor.name] = sensor


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
    has_own_root = raw.get("kind") in OWN_ROOT_KINDS
    needed = _NEEDED_SCENE_KEYS | (frozenset({"root"}) if has_own_root else frozenset({"sequence"}))
    require_keys(raw, _SCENE_KEYS, needed, where)
    given = {"sequence": raw["name"], **raw, "root": _root(raw, path, kitti360_root, home, where)}
    values: dict[str, Any] = {key: tuple(one) if isinstance(one, list) else one for key, one in given.items()}
    try:
        entry = SceneEntry(**values)
    except DataError as error:
        raise DataError(f"{where}: {error}") from error
    period_s = None if entry.sweep_period_s is None else float(entry.sweep_period_s)
    return replace(entry, test_frames=tuple(sorted(entry.test_frames)), sweep_period_s=period_s)


def _root(raw: dict[str, Any], path: Path, kitti360_root: Path | None, home: Path, where: str) -> Path:
    if "root" not in raw:
        return UNSET_ROOT if kitti360_root is None else kitti360_root.absolute()
    # joinpath keeps an absolute root as it is.
    return path.absolute().parent.joinpath(path_of(raw["root"], home, f"{where}: root"))


def _require_other_names(scenes: Mapping[str, SceneEntry], count: int | None = None) -> None:
    """Refuse names that differ only in case: on some disks they are one folder; or names of two."""
    if count is not None and len(scenes) != count:
        raise DataError("a part of a scene with `cut_frames` has the name of another scene; rename one")
    known: dict[str, str] = {}
    for name in scenes:
        other = known.setdefault(name.casefold(), name)
        if other != name:
            raise DataError(f"scenes {other!r} and {name!r} differ in case alone; rename one")
