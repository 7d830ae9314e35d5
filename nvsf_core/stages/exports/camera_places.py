"""Which cameras of a data set take the places that a format has: the one ahead, and those beside it."""

from collections.abc import Mapping, Sequence

import numpy as np

from nvsf_core.drives.kitti360.layout import CAMERAS
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.geometry.se3 import log_so3
from nvsf_core.stages.exports.records import CameraRecord

_AHEAD = "front"
"""Name of a camera that says by itself that it looks ahead."""
_ALIKE_DEG = 1.0
"""Cameras of a stereo pair look the same way within this; rectified ones do exactly."""


def pinholes_of(cameras: Mapping[str, CameraRecord]) -> list[str]:
    """Names of the pinhole cameras, the one that looks ahead first, the others in the given order.

    That is `front`; else the first of KITTI's own names; else the one whose optical axis lies nearest to the
    LiDAR's x axis, of several within 1 degree the first.
    """
    names = [name for name, one in cameras.items() if isinstance(one.model, Pinhole)]
    named = [name for name in (_AHEAD, *CAMERAS) if name in names]
    ahead = [*named, *_by_axis({name: cameras[name] for name in names})][:1]
    return [*ahead, *(name for name in names if name not in ahead)]


def are_parallel(first: CameraRecord, second: CameraRecord) -> bool:
    """Whether all axes of two cameras agree within 1 degree."""
    turn = first.in_lidar[:3, :3].T @ second.in_lidar[:3, :3]
    return bool(np.degrees(np.linalg.norm(log_so3(turn))) <= _ALIKE_DEG)


def in_free_places(names: Sequence[str], places: Sequence[str], own: Mapping[str, str]) -> dict[str, str]:
    """Places for those cameras that have none yet by `own`, of those that are free."""
    without = [name for name in names if name not in own]
    free = [place for place in places if place not in own.values()]
    return dict(zip(without, free, strict=False))


def _by_axis(cameras: Mapping[str, CameraRecord]) -> list[str]:
    """Cameras that look ahead, as nearly as the one that does so most."""
    axes = {name: one.in_lidar[:3, 2] for name, one in cameras.items()}
    off_deg = {name: np.degrees(np.arctan2(np.hypot(y, z), x)) for name, (x, y, z) in axes.items()}
    return [name for name, off in off_deg.items() if off <= min(off_deg.values()) + _ALIKE_DEG]
