"""Walking rays through a sparse voxel grid (Amanatides and Woo's DDA), in numba.

The grid is stored in bricks of 8 x 8 x 8 voxels: `bricks` holds a brick's row in `cells`, or -1;
`cells` holds a voxel's number, or -1. A ray is origin + t * direction, direction of unit length.
"""

import math

import numpy as np
from numba import njit, prange

BRICK = 8
_NO_PLANE_COSINE = 0.5
_NEVER_M = 1e300
RAYS_A_TASK = 256
"""Rays that one thread answers before it asks for more."""


@njit(inline="always")
def _clip(origin, direction, low, high, t_near, t_far):  # type: ignore[no-untyped-def]
    """[t_near, t_far] cut to a slab along one axis; an empty interval has t_near > t_far."""
    if direction == 0.0:
        if origin < low or origin >= high:
            return 1.0, 0.0
        return t_near, t_far
    a = (low - origin) / direction
    b = (high - origin) / direction
    return max(t_near, min(a, b)), min(t_far, max(a, b))


@njit(inline="always")
def _first_voxel(origin, direction, t, grid_origin, voxel_m, voxels):  # type: ignore[no-untyped-def]
    """Along one axis at distance t: voxel, its step, distance to its border, distance between borders."""
    index = min(max(math.floor((origin + t * direction - grid_origin) / voxel_m), 0), voxels - 1)
    if direction > 0.0:
        return index, 1, (grid_origin + (index + 1) * voxel_m - origin) / direction, voxel_m / direction
    if direction < 0.0:
        return index, -1, (grid_origin + index * voxel_m - origin) / direction, voxel_m / -direction
    # Never reached; times 0 it must not become NaN.
    return index, 1, _NEVER_M, 0.0


@njit(inline="always")
def _left(index, step):  # type: ignore[no-untyped-def]
    """Voxels that are left in the brick along one axis."""
    return BRICK - 1 - (index & 7) if step > 0 else index & 7


@njit(inline="always")
def _steps_before(leave, t_next, borders_a_metre, left):  # type: ignore[no-untyped-def]
    """Borders along one axis that are crossed before `leave`, of those inside the brick."""
    if t_next >= leave:
        return 0
    return min(left, int((leave - t_next) * borders_a_metre) + 1)


@njit(inline="always")
def _cross_brick(  # type: ignore[no-untyped-def]
    x, x_step, x_next, x_length, x_density, y, y_step, y_next, y_length, y_density,
    z, z_step, z_next, z_length, z_density,
):  # fmt: skip
    """Voxel and next border along each axis in the last voxel of an empty brick that the ray crosses."""
    x_left, y_left, z_left = _left(x, x_step), _left(y, y_step), _left(z, z_step)
    leave = min(x_next + x_left * x_length, min(y_next + y_left * y_length, z_next + z_left * z_length))
    x_steps = _steps_before(leave, x_next, x_density, x_left)
    y_steps = _steps_before(leave, y_next, y_density, y_left)
    z_steps = _steps_before(leave, z_next, z_density, z_left)
    return (
        x + x_steps * x_step, x_next + x_steps * x_length,
        y + y_steps * y_step, y_next + y_steps * y_length,
        z + z_steps * z_step, z_next + z_steps * z_length,
    )  # fmt: skip


@njit(parallel=True, cache=True)
def count_passes(origins, directions, stops_m, grid_origin, voxel_m, bricks, cells, n_voxels, n_threads):  # type: ignore[no-untyped-def]
    """How often each voxel was seen through by rays that end at `stops_m` (shape (n,)); (n_voxels,) int32."""
    partial = np.zeros((n_threads, n_voxels), np.int32)
    n = origins.shape[0]
    for thread in prange(n_threads):
        for ray in range(thread * n // n_threads, (thread + 1) * n // n_threads):
            _count_ray(
                origins[ray], directions[ray], float(stops_m[ray]), grid_origin, voxel_m, bricks, cells,
                partial[thread],
            )  # fmt: skip
    return partial.sum(axis=0)


@njit(cache=True)
def _count_ray(origin, direction, stop_m, grid_origin, voxel_m, bricks, cells, passes):  # type: ignore[no-untyped-def]
    """Add one to `passes` of each voxel that a ray has left again before `stop_m`."""
    x_voxels, y_voxels, z_voxels = bricks.shape[0] * BRICK, bricks.shape[1] * BRICK, bricks.shape[2] * BRICK
    ox, oy, oz = origin[0], origin[1], origin[2]
    dx, dy, dz = direction[0], direction[1], direction[2]
    t, t_far = _clip(ox, dx, grid_origin[0], grid_origin[0] + x_voxels * voxel_m, 0.0, stop_m)
    t, t_far = _clip(oy, dy, grid_origin[1], grid_origin[1] + y_voxels * voxel_m, t, t_far)
    t, t_far = _clip(oz, dz, grid_origin[2], grid_origin[2] + z_voxels * voxel_m, t, t_far)
    if t >= t_far:
        return
    x, x_step, x_next, x_length = _first_voxel(ox, dx, t, grid_origin[0], voxel_m, x_voxels)
    y, y_step, y_next, y_length = _first_voxel(oy, dy, t, grid_origin[1], voxel_m, y_voxels)
    z, z_step, z_next, z_length = _first_voxel(oz, dz, t, grid_origin[2], voxel_m, z_voxels)
    x_density, y_density, z_density = abs(dx) / voxel_m, abs(dy) / voxel_m, abs(dz) / voxel_m
    while True:
        row = bricks[x >> 3, y >> 3, z >> 3]
        if row < 0:
            x, x_next, y, y_next, z, z_next = _cross_brick(
                x, x_step, x_next, x_length, x_density, y, y_step, y_next, y_length, y_density,
                z, z_step, z_next, z_length, z_density,
            )  # fmt: skip
        nearest = min(x_next, min(y_next, z_next))
        if nearest > t_far:
            return
        if row >= 0:
            voxel = cells[row, ((x & 7) << 6) | ((y & 7) << 3) | (z & 7)]
            if voxel >= 0:
                passes[voxel] += 1
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


@njit(cache=True)
def walk(  # type: ignore[no-untyped-def]
    ray, origins, directions, near_m, far_m, grid_origin, voxel_m, bricks, cells,
    means, normals, opacities, missed_share, stop_transmittance,
    range_m, voxels, opacity, cosine,
):  # fmt: skip
    """Fill the last four arrays (k,) with the surfaces of one ray, see `find_candidates`; how many there are.

    Empty bricks are crossed in one step. All state is in scalars: the compiler keeps no array in registers.
    """
    most = range_m.shape[0]
    ny_bricks, nz_bricks = bricks.shape[1], bricks.shape[2]
    x_voxels, y_voxels, z_voxels = bricks.shape[0] * BRICK, ny_bricks * BRICK, nz_bricks * BRICK
    ox, oy, oz = origins[ray, 0], origins[ray, 1], origins[ray, 2]
    dx, dy, dz = directions[ray, 0], directions[ray, 1], directions[ray, 2]
    t, t_far = _clip(ox, dx, grid_origin[0], grid_origin[0] + x_voxels * voxel_m, near_m, far_m)
    t, t_far = _clip(oy, dy, grid_origin[1], grid_origin[1] + y_voxels * voxel_m, t, t_far)
    t, t_far = _clip(oz, dz, grid_origin[2], grid_origin[2] + z_voxels * voxel_m, t, t_far)
    if t >= t_far:
        return 0
    x, x_step, x_next, x_length = _first_voxel(ox, dx, t, grid_origin[0], voxel_m, x_voxels)
    y, y_step, y_next, y_length = _first_voxel(oy, dy, t, grid_origin[1], voxel_m, y_voxels)
    z, z_step, z_next, z_length = _first_voxel(oz, dz, t, grid_origin[2], voxel_m, z_voxels)
    x_density, y_density, z_density = abs(dx) / voxel_m, abs(dy) / voxel_m, abs(dz) / voxel_m
    light = 1.0
    found = 0
    while True:
        row = bricks[x >> 3, y >> 3, z >> 3]
        if row < 0:
            x, x_next, y, y_next, z, z_next = _cross_brick(
                x, x_step, x_next, x_length, x_density, y, y_step, y_next, y_length, y_density,
                z, z_step, z_next, z_length, z_density,
            )  # fmt: skip
        else:
            voxel = cells[row, ((x & 7) << 6) | ((y & 7) << 3) | (z & 7)]
            if voxel >= 0:
                t_out = min(min(x_next, min(y_next, z_next)), t_far)
                mx, my, mz = means[voxel, 0] - ox, means[voxel, 1] - oy, means[voxel, 2] - oz
                nx, ny, nz = normals[voxel, 0], normals[voxel, 1], normals[voxel, 2]
                alpha = float(opacities[voxel])
                slant = nx * dx + ny * dy + nz * dz
                if nx == 0.0 and ny == 0.0 and nz == 0.0:
                    hit = float(mx * dx + my * dy + mz * dz)
                    incidence = _NO_PLANE_COSINE
                else:
                    incidence = float(abs(slant))
                    hit = float((nx * mx + ny * my + nz * mz) / slant) if incidence > 1e-6 else -1.0
                    if hit < t or hit > t_out:
                        alpha *= missed_share
                range_m[found] = min(max(hit, t), t_out)
                voxels[found] = voxel
                opacity[found] = alpha
                cosine[found] = incidence
                found += 1
                light *= 1.0 - alpha
                if found == most or light < stop_transmittance:
                    return found
        if x_next <= y_next and x_next <= z_next:
            t = x_next
            x += x_step
            x_next += x_length
            inside = x >= 0 and x < x_voxels
        elif y_next <= z_next:
            t = y_next
            y += y_step
            y_next += y_length
            inside = y >= 0 and y < y_voxels
        else:
            t = z_next
            z += z_step
            z_next += z_length
            inside = z >= 0 and z < z_voxels
        if t >= t_far or not inside:
            return found


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
    range_m = np.zeros((n, n_candidates), np.float32)
    voxels = np.full((n, n_candidates), -1, np.int32)
    opacity = np.zeros((n, n_candidates), np.float32)
    cosine = np.zeros((n, n_candidates), np.float32)
    count = np.zeros(n, np.int32)
    for chunk in prange((n + RAYS_A_TASK - 1) // RAYS_A_TASK):
        for ray in range(chunk * RAYS_A_TASK, min(n, (chunk + 1) * RAYS_A_TASK)):
            count[ray] = walk(
                ray, origins, directions, near_m, far_m, grid_origin, voxel_m, bricks, cells,
                means, normals, opacities, missed_share, stop_transmittance,
                range_m[ray], voxels[ray], opacity[ray], cosine[ray],
            )  # fmt: skip
    return range_m, voxels, opacity, cosine, count
