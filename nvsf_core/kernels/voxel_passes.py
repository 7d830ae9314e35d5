"""How often the returns in voxels were seen through by rays that end behind them, in numba."""

from typing import Any

import numpy as np
from numba import get_num_threads, njit, prange

from nvsf_core.kernels.voxel_march import (
    BRICK,
    REACH,
    SOFT_M,
    clip,
    cross_cube,
    first_voxel,
    meet,
    voxel_at,
)


def count_passes(
    origins: np.ndarray, directions: np.ndarray, stops_m: np.ndarray, grid: Any, means: np.ndarray,
    normals: np.ndarray, precisions: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """How often each voxel's returns were seen through by rays that end at given distances.

    Args:
        origins: (n, 3) float32, scene-local.
        directions: (n, 3) float32, of unit length.
        stops_m: (n,) float32 where each ray ends.
        grid: A `VoxelIndex`: which voxels have returns.
        means: (v, 3) float32 mean of each voxel's returns, of a plane a point on it.
        normals: (v, 3) float32; 0 where the returns are no plane.
        precisions: (v, 6) float32, see `voxel_march`, or (0, 6).

    Returns:
        (2, v) int32: rays that left a voxel before their end and met its returns, and of these the rays that
        met them within their extent, all of them with (0, 6).
    """
    return _count_passes(origins, directions, stops_m, grid, means, normals, precisions, get_num_threads())


@njit(parallel=True, cache=True, nogil=True)
def _count_passes(  # type: ignore[no-untyped-def]
    origins, directions, stops_m, grid, means, normals, precisions, n_threads
):  # fmt: skip
    # Whole numbers: their sum is the same in any order.
    partial = np.zeros((n_threads, 2, means.shape[0]), np.int32)
    n = origins.shape[0]
    for thread in prange(n_threads):
        for ray in range(thread * n // n_threads, (thread + 1) * n // n_threads):
            _count_ray(
                origins[ray], directions[ray], float(stops_m[ray]), grid, means, normals, precisions,
                partial[thread],
            )  # fmt: skip
    return partial.sum(axis=0)


@njit(cache=True)
def _count_ray(  # type: ignore[no-untyped-def]
    origin, direction, stop_m, grid, means, normals, precisions, passes
):  # fmt: skip
    """Add one to `passes` (2, v) of each voxel whose returns a ray meets and leaves before its end."""
    grid_origin, voxel_m, bricks, cells, occupied, edges = grid
    x_voxels, y_voxels, z_voxels = bricks.shape[0] * BRICK, bricks.shape[1] * BRICK, bricks.shape[2] * BRICK
    ox, oy, oz = origin[0], origin[1], origin[2]
    dx, dy, dz = direction[0], direction[1], direction[2]
    t, t_far = clip(ox, dx, grid_origin[0], grid_origin[0] + x_voxels * voxel_m, 0.0, stop_m)
    t, t_far = clip(oy, dy, grid_origin[1], grid_origin[1] + y_voxels * voxel_m, t, t_far)
    t, t_far = clip(oz, dz, grid_origin[2], grid_origin[2] + z_voxels * voxel_m, t, t_far)
    if t >= t_far:
        return
    x, x_step, x_next, x_length = first_voxel(ox, dx, t, grid_origin[0], voxel_m, x_voxels)
    y, y_step, y_next, y_length = first_voxel(oy, dy, t, grid_origin[1], voxel_m, y_voxels)
    z, z_step, z_next, z_length = first_voxel(oz, dz, t, grid_origin[2], voxel_m, z_voxels)
    x_density, y_density, z_density = abs(dx) / voxel_m, abs(dy) / voxel_m, abs(dz) / voxel_m
    while True:
        row = bricks[x >> 3, y >> 3, z >> 3]
        last = edges[row] - 1 if row >= 0 else (BRICK << (-1 - row)) - 1
        if last > 0:
            x, x_next, y, y_next, z, z_next = cross_cube(
                last, x, x_step, x_next, x_length, x_density, y, y_step, y_next, y_length, y_density,
                z, z_step, z_next, z_length, z_density,
            )  # fmt: skip
        nearest = min(x_next, min(y_next, z_next))
        if nearest > t_far:
            return
        if row >= 0:
            voxel = voxel_at(row, x, y, z, occupied, cells)
            if voxel >= 0:
                _, off_m, apart, _ = meet(
                    means, normals, precisions, voxel, ox, oy, oz, dx, dy, dz, t, nearest
                )  # fmt: skip
                if off_m <= SOFT_M:
                    passes[0, voxel] += 1
                    if apart <= REACH:
                        passes[1, voxel] += 1
        t = nearest
        if x_next <= y_next and x_next <= z_next:
            x += x_step
            x_next += x_length
            inside = x >= 0 and x < x_voxels
        elif y_next <= z_next:
            y += y_step
            y_next += y_length
            inside = y >= 0 and y < y_voxels
        else:
            z += z_step
            z_next += z_length
            inside = z >= 0 and z < z_voxels
        if not inside:
            return
