"""How often the returns in voxels were seen through by rays that end behind them, in numba."""

from typing import Any, NamedTuple

import numpy as np
from numba import get_num_threads, njit, prange

from nvsf_core.kernels.voxel_march import (
    BRICK,
    REACH,
    SOFT_M,
    clip,
    closest,
    cross_brick,
    first_voxel,
    off_plane,
    voxel_at,
)


class MetPlanes(NamedTuple):
    """Planes in voxels, and up to where rays that meet them have seen through them."""

    stops_m: np.ndarray
    """(n,) float32 metres along each of n rays; (0,) = planes are not asked about."""
    mean_m: np.ndarray
    """(v, 3) float32, scene-local: a point of each plane."""
    normal: np.ndarray
    """(v, 3) float32; 0 where there is none: every ray that crosses the voxel meets what is there."""


_NO_PLANES = MetPlanes(np.zeros(0, np.float32), np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32))


def count_passes(
    origins: np.ndarray, directions: np.ndarray, stops_m: np.ndarray, grid: Any, means: np.ndarray,
    precisions: np.ndarray, planes: MetPlanes = _NO_PLANES,
) -> np.ndarray:  # fmt: skip
    """How often each voxel's returns were seen through by rays that end at given distances.

    Args:
        origins: (n, 3) float32, scene-local.
        directions: (n, 3) float32, of unit length.
        stops_m: (n,) float32 where each ray ends.
        grid: A `VoxelIndex`: which voxels have returns.
        means: (v, 3) float32 mean of each voxel's returns.
        precisions: (v, 6) float32, or (0, 6) without shapes.
        planes: Planes of the same voxels, if it is asked how often these were seen through.

    Returns:
        (1, v) int32: rays that met a voxel's returns (see `voxel_march`; without shapes, crossed the voxel)
        and left the voxel before their end. With planes (2, v): the second row of them, of the same walk.
    """
    counted: np.ndarray = _count_passes(
        origins, directions, stops_m, grid, means, precisions, planes, get_num_threads()
    )
    return counted


@njit(parallel=True, cache=True, nogil=True)
def _count_passes(  # type: ignore[no-untyped-def]
    origins, directions, stops_m, grid, means, precisions, planes, n_threads
):  # fmt: skip
    # Whole numbers: their sum is the same in any order.
    partial = np.zeros((n_threads, 2 if len(planes.stops_m) else 1, means.shape[0]), np.int32)
    n = origins.shape[0]
    for thread in prange(n_threads):
        for ray in range(thread * n // n_threads, (thread + 1) * n // n_threads):
            plane_m = float(planes.stops_m[ray]) if len(planes.stops_m) else -1.0
            _count_ray(
                origins[ray], directions[ray], (float(stops_m[ray]), plane_m), grid, means, precisions,
                planes, partial[thread],
            )  # fmt: skip
    return partial.sum(axis=0)


@njit(cache=True)
def _count_ray(  # type: ignore[no-untyped-def]
    origin, direction, stops_m, grid, means, precisions, planes, passes
):  # fmt: skip
    """Add one to `passes` (1, v) of each voxel whose returns a ray meets and that it has left before its end.

    Of (2, v) the second row counts all voxels whose planes it meets before its second end.
    """
    (shape_m, plane_m), (grid_origin, voxel_m, bricks, cells, occupied) = stops_m, grid
    stop_m = max(shape_m, plane_m)
    x_voxels, y_voxels, z_voxels = bricks.shape[0] * BRICK, bricks.shape[1] * BRICK, bricks.shape[2] * BRICK
    ox, oy, oz = origin[0], origin[1], origin[2]
    dx, dy, dz = direction[0], direction[1], direction[2]
    t, t_far = clip(ox, dx, grid_origin[0], grid_origin[0] + x_voxels * voxel_m, 0.0, stop_m)
    t, t_far = clip(oy, dy, grid_origin[1], grid_origin[1] + y_voxels * voxel_m, t, t_far)
    t, t_far = clip(oz, dz, grid_origin[2], grid_origin[2] + z_voxels * voxel_m, t, t_far)
    if t >= t_far:
        return
    # A ray that ends where it begins has passed nothing, also where it begins on a border.
    shape_m, plane_m = shape_m if shape_m > t else -1.0, plane_m if plane_m > t else -1.0
    x, x_step, x_next, x_length = first_voxel(ox, dx, t, grid_origin[0], voxel_m, x_voxels)
    y, y_step, y_next, y_length = first_voxel(oy, dy, t, grid_origin[1], voxel_m, y_voxels)
    z, z_step, z_next, z_length = first_voxel(oz, dz, t, grid_origin[2], voxel_m, z_voxels)
    x_density, y_density, z_density = abs(dx) / voxel_m, abs(dy) / voxel_m, abs(dz) / voxel_m
    while True:
        row = bricks[x >> 3, y >> 3, z >> 3]
        if row < 0:
            x, x_next, y, y_next, z, z_next = cross_brick(
                x, x_step, x_next, x_length, x_density, y, y_step, y_next, y_length, y_density,
                z, z_step, z_next, z_length, z_density,
            )  # fmt: skip
        nearest = min(x_next, min(y_next, z_next))
        if nearest > t_far:
            return
        if row >= 0:
            voxel = voxel_at(row, x, y, z, occupied, cells)
            if voxel >= 0:
                apart = 0.0
                if precisions.shape[0] > 0:
                    _, apart = closest(
                        precisions, voxel, means[voxel, 0] - ox, means[voxel, 1] - oy, means[voxel, 2] - oz,
                        dx, dy, dz,
                    )  # fmt: skip
                if apart <= REACH and nearest <= shape_m:
                    passes[0, voxel] += 1
                if nearest <= plane_m:
                    off_m = off_plane(
                        planes.mean_m, planes.normal, voxel, ox, oy, oz, dx, dy, dz, t, nearest
                    )  # fmt: skip
                    if off_m <= SOFT_M:
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
