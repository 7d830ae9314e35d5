"""Rays that cross the box around a moving object, each ray at its own time, in numba.

The object's poses are x, y, z in scene-local metres and yaw in radians, linear in time between its scans and
with constant velocity beyond them, as `MovingObject.pose_at` says.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit, prange

from nvsf_core.kernels.voxel_march import RAYS_A_TASK, clip


class MovingBounds(NamedTuple):
    """A box that moves, and the rays that may meet it at all."""

    axis: np.ndarray
    """(3,) unit: rays that meet the box run within an angle of this direction."""
    least_cosine: float
    """Cosine of that angle."""
    first_s: float
    """Time from which the box is there, seconds."""
    last_s: float
    """Time until which it is there, seconds."""
    path_time_s: np.ndarray
    """(k,) float64 ascending, k >= 1."""
    path_pose: np.ndarray
    """(k, 4) float64 x, y, z in scene-local metres and yaw in radians, at these times."""
    low_m: np.ndarray
    """(3,) lower corner in the box's own frame."""
    high_m: np.ndarray
    """(3,) upper corner."""


@njit(inline="always")
def _interval(time_s, path_time_s):  # type: ignore[no-untyped-def]
    """The two poses (the same where there is one) that a time lies between, and the share of the second."""
    if len(path_time_s) == 1:
        return 0, 0, 0.0
    before = 0
    while before < len(path_time_s) - 2 and path_time_s[before + 1] < time_s:
        before += 1
    start_s = path_time_s[before]
    return before, before + 1, (time_s - start_s) / (path_time_s[before + 1] - start_s)


@njit(inline="always")
def _between(path_pose, axis, a, b, share):  # type: ignore[no-untyped-def]
    return path_pose[a, axis] + share * (path_pose[b, axis] - path_pose[a, axis])


@njit(inline="always")
def _in_its_frame(origin, direction, time_s, path_time_s, path_pose):  # type: ignore[no-untyped-def]
    """Origin and direction, three numbers each, in the object's frame at a time."""
    a, b, share = _interval(time_s, path_time_s)
    yaw_rad = _between(path_pose, 3, a, b, share)
    cosine, sine = math.cos(yaw_rad), math.sin(yaw_rad)
    ox = origin[0] - _between(path_pose, 0, a, b, share)
    oy = origin[1] - _between(path_pose, 1, a, b, share)
    oz = origin[2] - _between(path_pose, 2, a, b, share)
    dx, dy, dz = float(direction[0]), float(direction[1]), float(direction[2])
    return (
        cosine * ox + sine * oy, cosine * oy - sine * ox, oz,
        cosine * dx + sine * dy, cosine * dy - sine * dx, dz,
    )  # fmt: skip


@njit(parallel=True, cache=True, nogil=True)
def rays_into_bounds(  # type: ignore[no-untyped-def]
    origins, directions, time_s, box
):
    """Which of n rays cross a box that moves.

    Args:
        origins: (n, 3), scene-local.
        directions: (n, 3) unit.
        time_s: (n,) when each is fired.
        box: `MovingBounds`; direction and time are compared first, of every ray.

    Returns:
        ray (m,) int64 ascending; origins and directions (m, 3) float32 in the box's frame.
    """
    axis, least_cosine, first_s, last_s, path_time_s, path_pose, low_m, high_m = box
    n = len(time_s)
    crosses = np.zeros(n, np.bool_)
    for task in prange((n + RAYS_A_TASK - 1) // RAYS_A_TASK):
        for ray in range(task * RAYS_A_TASK, min(n, (task + 1) * RAYS_A_TASK)):
            d = directions[ray]
            if d[0] * axis[0] + d[1] * axis[1] + d[2] * axis[2] < least_cosine:
                continue
            if time_s[ray] < first_s or time_s[ray] > last_s:
                continue
            ox, oy, oz, dx, dy, dz = _in_its_frame(origins[ray], d, time_s[ray], path_time_s, path_pose)
            enter, leave = clip(ox, dx, low_m[0], high_m[0], 0.0, math.inf)
            enter, leave = clip(oy, dy, low_m[1], high_m[1], enter, leave)
            enter, leave = clip(oz, dz, low_m[2], high_m[2], enter, leave)
            crosses[ray] = enter < leave
    rays = np.flatnonzero(crosses)
    origins_o, directions_o = np.empty((len(rays), 3), np.float32), np.empty((len(rays), 3), np.float32)
    for i in prange(len(rays)):
        ray = rays[i]
        ox, oy, oz, dx, dy, dz = _in_its_frame(
            origins[ray], directions[ray], time_s[ray], path_time_s, path_pose
        )
        origins_o[i, 0], origins_o[i, 1], origins_o[i, 2] = ox, oy, oz
        directions_o[i, 0], directions_o[i, 1], directions_o[i, 2] = dx, dy, dz
    return rays, origins_o, directions_o
