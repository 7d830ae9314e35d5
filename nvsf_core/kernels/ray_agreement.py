"""How far recorded scans agree with what rays show, and which places lie in occupied voxels; in numba."""

import math

import numpy as np
from numba import njit, prange

from nvsf_core.kernels.scan_lookup import EMPTY, SAME, THROUGH
from nvsf_core.kernels.voxel_lookup import number_at

_SAME_DIRECTION_COSINE = math.cos(math.radians(20.0))
_SAME_DISTANCE_RATIO = 1.5
_NEAREST_M = 1e-3
_RAYS_A_TASK = 4096


# Wide: columns of the rays, of what the scan recorded and of the result.
@njit(parallel=True, cache=True, nogil=True)
def add_agreement(  # type: ignore[no-untyped-def]
    ends_m, direction, range_m, returned, position_m, found, agreed, others, looked
):
    """Add what one scan says of r rays.

    It agrees with a ray if it recorded the same at the ray's end, from about the same direction (20 degrees)
    and distance (ratio 1.5); without an end, if it had no return that way.

    Args:
        ends_m: (r, 3) float32 where the rays end, or would be looked up.
        direction: (r, 3) float32 unit.
        range_m: (r,) float32, infinite = no end.
        returned: (r,) bool, whether they show a return.
        position_m: (3,) float64, of the scan's sensor.
        found: (r, 5) float32, columns of `look_up_scans`.
        agreed: (r,) float32, is added to: 1 if the scan agrees.
        others: (r,) float32, is added to: 1 if it recorded something else there.
        looked: (r,) bool, is set where it looked that way.
    """
    rays = len(range_m)
    for task in prange((rays + _RAYS_A_TASK - 1) // _RAYS_A_TASK):
        for ray in range(task * _RAYS_A_TASK, min(rays, (task + 1) * _RAYS_A_TASK)):
            same = found[ray, SAME] if returned[ray] else found[ray, EMPTY]
            others[ray] += found[ray, SAME] + found[ray, THROUGH] + found[ray, EMPTY] - same
            for column in range(found.shape[1]):
                looked[ray] |= found[ray, column] != 0.0
            if same != 0.0 and _is_alike(ends_m[ray], direction[ray], range_m[ray], position_m):
                agreed[ray] += same


@njit(inline="always")
def _is_alike(end_m, direction, range_m, position_m):  # type: ignore[no-untyped-def]
    if not math.isfinite(range_m):
        return True
    x, y, z = end_m[0] - position_m[0], end_m[1] - position_m[1], end_m[2] - position_m[2]
    distance_m = math.sqrt(x * x + y * y + z * z)
    along_m = x * direction[0] + y * direction[1] + z * direction[2]
    ratio = max(distance_m, _NEAREST_M) / max(range_m, _NEAREST_M)
    is_same_far = 1.0 / _SAME_DISTANCE_RATIO < ratio < _SAME_DISTANCE_RATIO
    return along_m >= _SAME_DIRECTION_COSINE * distance_m and is_same_far


@njit(parallel=True, cache=True, nogil=True)
def holds_points(points_m, index, reach=0):  # type: ignore[no-untyped-def]
    """Whether points (n, 3) lie in a voxel of a `VoxelIndex`, or at most `reach` voxels beside one."""
    origin_m, voxel_m = index.origin_m, index.voxel_m
    holds = np.zeros(len(points_m), np.bool_)
    for task in prange((len(points_m) + _RAYS_A_TASK - 1) // _RAYS_A_TASK):
        for point in range(task * _RAYS_A_TASK, min(len(points_m), (task + 1) * _RAYS_A_TASK)):
            x = math.floor((points_m[point, 0] - origin_m[0]) / voxel_m)
            y = math.floor((points_m[point, 1] - origin_m[1]) / voxel_m)
            z = math.floor((points_m[point, 2] - origin_m[2]) / voxel_m)
            for i in range(x - reach, x + reach + 1):
                for j in range(y - reach, y + reach + 1):
                    for k in range(z - reach, z + reach + 1):
                        holds[point] |= number_at(i, j, k, index.bricks, index.cells) >= 0
    return holds
