"""Walking rays through a sparse voxel grid (Amanatides and Woo's DDA), in numba.

The grid is stored in bricks of 8 x 8 x 8 voxels: `bricks` holds a brick's row in `cells`, or -1;
`cells` holds a voxel's number, or -1. A ray is origin + t * direction, direction of unit length.
"""

import math

import numpy as np
from numba import njit, prange

BRICK = 8
_NO_PLANE_COSINE = 0.5


@njit(inline="always")
def _enter(origin, direction, low, high, t_near, t_far):  # type: ignore[no-untyped-def]
    """Clip [t_near, t_far] to the box; an empty interval has t_near > t_far."""
    for axis in range(3):
        if direction[axis] == 0.0:
            if origin[axis] < low[axis] or origin[axis] >= high[axis]:
                return 1.0, 0.0
            continue
        a = (low[axis] - origin[axis]) / direction[axis]
        b = (high[axis] - origin[axis]) / direction[axis]
        t_near = max(t_near, min(a, b))
        t_far = min(t_far, max(a, b))
    return t_near, t_far


@njit(inline="always")
def _start(origin, direction, t, grid_origin, voxel_m, shape, index, step, t_next, t_step):  # type: ignore[no-untyped-def]
    """Set up the walk at distance t."""
    for axis in range(3):
        position = (origin[axis] + t * direction[axis] - grid_origin[axis]) / voxel_m
        index[axis] = min(max(math.floor(position), 0), shape[axis] - 1)
        if direction[axis] > 0.0:
            step[axis] = 1
            border = grid_origin[axis] + (index[axis] + 1) * voxel_m
        else:
            step[axis] = -1
            border = grid_origin[axis] + index[axis] * voxel_m
        if direction[axis] == 0.0:
            t_next[axis] = np.inf
            t_step[axis] = np.inf
        else:
            t_next[axis] = (border - origin[axis]) / direction[axis]
            t_step[axis] = voxel_m / abs(direction[axis])


@njit(inline="always")
def _voxel(index, bricks, cells):  # type: ignore[no-untyped-def]
    row = bricks[index[0] >> 3, index[1] >> 3, index[2] >> 3]
    if row < 0:
        return -1
    return cells[row, ((index[0] & 7) << 6) | ((index[1] & 7) << 3) | (index[2] & 7)]


@njit(inline="always")
def _nearest_axis(t_next):  # type: ignore[no-untyped-def]
    if t_next[0] <= t_next[1] and t_next[0] <= t_next[2]:
        return 0
    return 1 if t_next[1] <= t_next[2] else 2


@njit(parallel=True, cache=True)
def count_passes(origins, directions, stops_m, grid_origin, voxel_m, bricks, cells, n_voxels, n_threads):  # type: ignore[no-untyped-def]
    """How often each voxel was seen through by rays that end at `stops_m` (shape (n,)); (n_voxels,) int32."""
    partial = np.zeros((n_threads, n_voxels), np.int32)
    shape = np.array([bricks.shape[0] * BRICK, bricks.shape[1] * BRICK, bricks.shape[2] * BRICK])
    high = grid_origin + shape * voxel_m
    n = origins.shape[0]
    for thread in prange(n_threads):
        index = np.zeros(3, np.int64)
        step = np.zeros(3, np.int64)
        t_next = np.zeros(3)
        t_step = np.zeros(3)
        for ray in range(thread * n // n_threads, (thread + 1) * n // n_threads):
            origin = origins[ray]
            direction = directions[ray]
            t, t_far = _enter(origin, direction, grid_origin, high, 0.0, float(stops_m[ray]))
            if t >= t_far:
                continue
            _start(origin, direction, t, grid_origin, voxel_m, shape, index, step, t_next, t_step)
            while True:
                axis = _nearest_axis(t_next)
                if t_next[axis] > t_far:
                    break
                voxel = _voxel(index, bricks, cells)
                if voxel >= 0:
                    partial[thread, voxel] += 1
                index[axis] += step[axis]
                if index[axis] < 0 or index[axis] >= shape[axis]:
                    break
                t_next[axis] += t_step[axis]
    return partial.sum(axis=0)


@njit(parallel=True, cache=True)
def find_candidates(  # type: ignore[no-untyped-def]
    origins, directions, near_m, far_m, grid_origin, voxel_m, bricks, cells,
    means, normals, opacities, missed_share, stop_transmittance, n_candidates,
):  # fmt: skip
    """The surfaces that each ray may end on, in order.

    A voxel's candidate is where the ray meets its plane (normal not 0), else where it passes its mean
    closest, kept inside the voxel; a plane that is missed inside the voxel keeps `missed_share` of its
    opacity. The walk ends at `n_candidates` or where less than `stop_transmittance` of the light is left.

    Returns:
        range_m (n, k) float32, 0 where there is none; voxel (n, k) int32, -1 where there is none;
        opacity (n, k) float32; cosine of incidence (n, k) float32; count (n,) int32.
    """
    n = origins.shape[0]
    shape = np.array([bricks.shape[0] * BRICK, bricks.shape[1] * BRICK, bricks.shape[2] * BRICK])
    high = grid_origin + shape * voxel_m
    range_m = np.zeros((n, n_candidates), np.float32)
    voxels = np.full((n, n_candidates), -1, np.int32)
    opacity = np.zeros((n, n_candidates), np.float32)
    cosine = np.zeros((n, n_candidates), np.float32)
    count = np.zeros(n, np.int32)
    n_chunks = (n + 255) // 256
    for chunk in prange(n_chunks):
        index = np.zeros(3, np.int64)
        step = np.zeros(3, np.int64)
        t_next = np.zeros(3)
        t_step = np.zeros(3)
        for ray in range(chunk * 256, min(n, (chunk + 1) * 256)):
            o = origins[ray]
            d = directions[ray]
            t, t_far = _enter(o, d, grid_origin, high, near_m, far_m)
            if t >= t_far:
                continue
            _start(o, d, t, grid_origin, voxel_m, shape, index, step, t_next, t_step)
            light = 1.0
            found = 0
            while True:
                axis = _nearest_axis(t_next)
                t_out = min(t_next[axis], t_far)
                voxel = _voxel(index, bricks, cells)
                if voxel >= 0:
                    mx = means[voxel, 0] - o[0]
                    my = means[voxel, 1] - o[1]
                    mz = means[voxel, 2] - o[2]
                    nx = normals[voxel, 0]
                    ny = normals[voxel, 1]
                    nz = normals[voxel, 2]
                    alpha = opacities[voxel]
                    slant = nx * d[0] + ny * d[1] + nz * d[2]
                    if nx == 0.0 and ny == 0.0 and nz == 0.0:
                        hit = mx * d[0] + my * d[1] + mz * d[2]
                        incidence = _NO_PLANE_COSINE
                    else:
                        incidence = abs(slant)
                        hit = (nx * mx + ny * my + nz * mz) / slant if incidence > 1e-6 else -1.0
                        if hit < t or hit > t_out:
                            alpha *= missed_share
                    range_m[ray, found] = min(max(hit, t), t_out)
                    voxels[ray, found] = voxel
                    opacity[ray, found] = alpha
                    cosine[ray, found] = incidence
                    found += 1
                    light *= 1.0 - alpha
                    if found == n_candidates or light < stop_transmittance:
                        break
                if t_next[axis] >= t_far:
                    break
                t = t_next[axis]
                index[axis] += step[axis]
                if index[axis] < 0 or index[axis] >= shape[axis]:
                    break
                t_next[axis] += t_step[axis]
            count[ray] = found
    return range_m, voxels, opacity, cosine, count
