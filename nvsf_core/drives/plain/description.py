"""Reading of a plain drive's `drive.json` and `cameras.json`."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os.path import lexists
from pathlib import Path
from typing import Any

import numpy as np

from nvsf_core.drives.kinds import is_number
from nvsf_core.drives.kitti360.calibration import Calibration, CameraCalibration
from nvsf_core.drives.kitti360.text import read_calibration_text, rigid
from nvsf_core.drives.lenses import Lens, lens_of
from nvsf_core.drives.view_parts import CAMERA_NAME
from nvsf_core.errors import CalibrationError
from nvsf_core.names import printable
from nvsf_core.sensors.tables import SENSOR_TABLES

_LONGEST_ARM_M = 100.0
_LATEST_S = 1e10
"""Seconds from 1970 to the year 2286; larger numbers are of another unit."""
_LONGEST_DELAY_S = 10.0
"""Of labels after their frames; larger numbers are of another unit."""
_FOUND = "found"
_DRIVE_KEYS = (
    "lidar",
    "intensity_max",
    "lidar_to_pose",
    "times_assumed",
    "clock_origin_s",
    "boxes_after_s",
    "notes",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Description:
    """What `drive.json` says; without the file all has its default."""

    lidar: str = ""
    """Name of the LiDAR's table; empty = to be found from the scans."""
    intensity_max: float = 1.0
    """Intensity of the brightest returns, as 255."""
    lidar_to_pose: np.ndarray
    """(4, 4) LiDAR to the frame that `poses.csv` speaks of."""
    times_assumed: str = ""
    """Why the frames' times are assumed ones, in words; empty = they are recorded."""
    clock_origin_s: float | None = None
    """Seconds from 1970-01-01 to 0 s of the tables' times; None = not known."""
    boxes_after_s: float = 0.0
    """Seconds from a frame's time to the moment that its boxes are of."""


def read_description(path: Path) -> Description:
    """Read `drive.json`, or the defaults where it is absent.

    Raises:
        CalibrationError: It cannot be read, or a key is unknown or has a wrong value.
    """
    if not lexists(path):
        return Description(lidar_to_pose=np.eye(4))
    raw = read_json(path)
    unknown = sorted(set(raw) - set(_DRIVE_KEYS))
    if unknown:
        raise CalibrationError(f"{path}: expected {', '.join(_DRIVE_KEYS)}, found {unknown[0]!r:.60}")
    lidar = raw.get("lidar", _FOUND)
    if not isinstance(lidar, str) or (lidar != _FOUND and lidar not in SENSOR_TABLES):
        raise CalibrationError(
            f"{path}: lidar: expected {_FOUND!r} or one of {', '.join(SENSOR_TABLES)}, found {lidar!r:.60}"
        )
    brightest = raw.get("intensity_max", 1.0)
    if not is_number(brightest) or not 0.0 < brightest < 1e9:
        raise CalibrationError(f"{path}: intensity_max: expected a number above 0, found {brightest!r:.60}")
    assumed = raw.get("times_assumed", "")
    if not isinstance(assumed, str) or not assumed.isprintable():
        raise CalibrationError(f"{path}: times_assumed: expected why, in a line, found {assumed!r:.60}")
    origin_s = raw.get("clock_origin_s")
    if origin_s is not None and not (is_number(origin_s) and abs(origin_s) < _LATEST_S):
        raise CalibrationError(
            f"{path}: clock_origin_s: expected seconds from 1970-01-01 to 0 s of the tables, found "
            f"{origin_s!r:.60}"
        )
    later_s = raw.get("boxes_after_s", 0.0)
    if not is_number(later_s) or not abs(later_s) <= _LONGEST_DELAY_S:
        raise CalibrationError(
            f"{path}: boxes_after_s: expected seconds from a frame's time to its boxes', at most "
            f"{_LONGEST_DELAY_S:g}, found {later_s!r:.60}"
        )
    return Description(
        lidar="" if lidar == _FOUND else lidar, intensity_max=float(brightest),
        lidar_to_pose=_mounting(raw, "lidar_to_pose", str(path), np.eye(4)),
        times_assumed=assumed, clock_origin_s=None if origin_s is None else float(origin_s),
        boxes_after_s=float(later_s),
    )  # fmt: skip


def read_cameras(
    path: Path, wanted: Sequence[str] | None, present: Sequence[str], lidar_to_pose: np.ndarray
) -> tuple[Calibration, dict[str, Lens]]:
    """Calibration of the wanted cameras, and how their images are rectified.

    Args:
        path: `cameras.json`; it may be absent in a drive without images.
        wanted: Cameras that the scene asks for; None = all that are present and described.
        present: Cameras that have images.
        lidar_to_pose: (4, 4).

    Raises:
        CalibrationError: It cannot be read, a camera is wanted and absent, or its description is damaged.
    """
    raw = read_json(path) if lexists(path) else {}
    for name in wanted or ():
        if name not in present or name not in raw:
            what = "no images" if name not in present else f"no entry in {path.name}"
            raise CalibrationError(f"{path.parent}: camera {name} was asked for, but has {what}; add it")
    notes = [f"{printable(name)} left out: no entry in {path.name}" for name in present if name not in raw]
    notes += [f"{printable(name)} left out: no images of it" for name in raw if name not in present]
    names = [name for name in present if name in raw] if wanted is None else list(wanted)
    cameras, lenses = {}, {}
    for name in names:
        where = f"{path}: {name}"
        if not CAMERA_NAME.fullmatch(name):
            raise CalibrationError(f"{where}: expected a name of a-z, 0-9 and _, from a letter; rename it")
        if not isinstance(raw[name], dict):
            raise CalibrationError(f"{where}: expected an object, found {raw[name]!r:.60}")
        lenses[name] = lens_of(raw[name], where)
        to_lidar = _mounting(raw[name], "camera_to_lidar", where, None)
        cameras[name] = CameraCalibration(
            name=name, intrinsics=lenses[name].intrinsics, to_pose=lidar_to_pose @ to_lidar
        )
    found = Calibration(
        lidar_to_pose=lidar_to_pose, lidar_is_assumed=False, cameras=cameras,
        notes=tuple(notes) if wanted is None else (),
    )  # fmt: skip
    return found, lenses


def read_json(path: Path) -> dict[str, Any]:
    """An object of a small JSON file.

    Raises:
        CalibrationError: It cannot be read, is none, or has a key twice, of which only one would hold.
    """
    try:
        raw = json.loads(read_calibration_text(path), object_pairs_hook=_once_each)
    except (ValueError, RecursionError) as error:
        raise CalibrationError(f"{path}: expected JSON ({error!s:.100}); correct the file") from error
    if not isinstance(raw, dict):
        raise CalibrationError(f"{path}: expected a JSON object, found {raw!r:.60}")
    return raw


def _once_each(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    names = [name for name, _ in pairs]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise ValueError(f"expected each key once, found {twice[0]!r:.60} again")
    return dict(pairs)


def _mounting(raw: Mapping[str, Any], key: str, where: str, default: np.ndarray | None) -> np.ndarray:
    values = raw.get(key)
    if values is None and default is not None:
        return default
    try:
        found = np.array(values, np.float64).reshape(-1)
        if len(found) not in (12, 16) or not np.isfinite(found).all():
            raise ValueError(f"expected 16 finite numbers, found {len(found)}")
        if len(found) == 16 and np.abs(found[12:] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-6:
            raise ValueError(f"expected the last row 0 0 0 1, found {found[12:].tolist()}")
        return rigid(found[:12], _LONGEST_ARM_M)
    except (ValueError, TypeError, OverflowError) as error:
        raise CalibrationError(f"{where}: {key}: {error}; give a 4 x 4 matrix row by row") from error
