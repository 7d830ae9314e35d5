"""Walking rays through a sparse voxel grid (Amanatides and Woo's DDA), in numba.

The grid is stored in bricks of 8 x 8 x 8 voxels: `bricks` holds a brick's row in `cells`, or -1;
`cells` holds a voxel's number, or -1, and `occupied` as bits which voxels have one. A ray is
origin + t * direction, direction of unit length.

A voxel's returns fill it unevenly. Where their shape is known, by `precisions` (v, 6), a ray meets them only
if it passes within 2.5 of their own standard deviations, else it neither sees through them nor ends there.
Precisions are inverse covariances, 1/m^2: xx, xy, xz, yy, yz, zz; (0, 6) where no shapes are known.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numba import get_num_threads, njit, prange

BRICK = 8
_NO_PLANE_COSINE = 0.5
_NEVER_M = 1e300
_REACH = 6.25
"""Square of the largest distance, in standard deviations of a voxel's returns, at which a ray meets them."""
_FALL = 0.2
"""At `apart` squared standard deviations off, returns that are no plane stop exp(-_FALL * apart) of what they
stop in their middle. Planes stop as much out to their ends: walls must not leak between voxels."""
_NO_STOPS = np.zeros(0, np.float32)
RAYS_A_TASK = 256
"""Rays that one thread renders before it takes more."""


class VoxelSurfaces(NamedTuple):
    """The surface in each of v voxels."""

    mean_m: np.ndarray
    """(v, 3) float32, scene-local."""
    normal: np.ndarray
    """(v, 3) float32; 0 where the returns are no plane."""
    precision: np.ndarray
    """(v, 6) float32; (0, 6) where no shapes are known."""
    opacity: np.ndarray
    """(v,) float32."""
    intensity: np.ndarray
    """(v,) float32."""
    hits: np.ndarray
    """(v,) int32."""


class WalkLimits(NamedTuple):
    """Where a walk begins and ends, and what a missed surface still stops."""

    near_m: float
    far_m: float
    most: int
    """Surfaces after which the walk ends."""
    missed_share: float
    """Share of its opacity that a surface keeps for a ray that misses it inside its voxel."""
    stop_transmittance: float
    """The walk ends where less of the light than this is left."""
    faintest: float
    """Surfaces that stop less of the ray's light than this are left out, as if nothing were there."""


@njit(inline="always")
def clip(origin, direction, low, high, t_near, t_far):  # type: ignore[no-untyped-def]
    """[t_near, t_far] of a ray cut to a slab along one axis; an empty interval has t_near > t_far.

    Args:
        origin: Of the ray, along the axis.
        direction: Of the ray, along the axis.
        low: Lower face of the slab.
        high: Upper face.
        t_near: Start of the interval, metres along the ray.
        t_far: Its end.
    """
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
def _closest(precisions, voxel, mx, my, mz, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Where a ray passes a voxel's returns closest, and how close, in squares of their standard deviation.

    With precision P, mean m from the ray's origin and direction d: the t that minimises
    (m - t d)^T P (m - t d). It is sought from the foot of the mean on the ray, near which float32 is fine.
    """
    xx, xy, xz = precisions[voxel, 0], precisions[voxel, 1], precisions[voxel, 2]
    yy, yz, zz = precisions[voxel, 3], precisions[voxel, 4], precisions[voxel, 5]
    foot = mx * dx + my * dy + mz * dz
    ex, ey, ez = mx - foot * dx, my - foot * dy, mz - foot * dz
    px, py, pz = xx * dx + xy * dy + xz * dz, xy * dx + yy * dy + yz * dz, xz * dx + yz * dy + zz * dz
    onward = (px * ex + py * ey + pz * ez) / (px * dx + py * dy + pz * dz)
    ex, ey, ez = ex - onward * dx, ey - onward * dy, ez - onward * dz
    apart = xx * ex * ex + yy * ey * ey + zz * ez * ez + 2.0 * (xy * ex * ey + xz * ex * ez + yz * ey * ez)
    return float(foot + onward), apart


@njit(inline="always")
def _voxel_at(row, x, y, z, occupied, cells):  # type: ignore[no-untyped-def]
    """A voxel's number, or -1 in most: their bits lie in a nearer cache than their numbers would."""
    within = ((y & 7) << 3) | (z & 7)
    is_there = (occupied[row, x & 7] >> np.uint64(within)) & np.uint64(1) != np.uint64(0)
    return cells[row, ((x & 7) << 6) | within] if is_there else np.int32(-1)


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


def count_passes(
    origins: np.ndarray, directions: np.ndarray, stops_m: np.ndarray, grid: Any, means: np.ndarray,
    precisions: np.ndarray, crossed_stops_m: np.ndarray = _NO_STOPS,
) -> np.ndarray:  # fmt: skip
    """How often each voxel's returns were seen through by rays that end at given distances.

    Args:
        origins: (n, 3) float32, scene-local.
        directions: (n, 3) float32, of unit length.
        stops_m: (n,) float32 where each ray ends.
        grid: A `VoxelIndex`: which voxels have returns.
        means: (v, 3) float32 mean of each voxel's returns.
        precisions: (v, 6) float32, or (0, 6) without shapes.
        crossed_stops_m: (n,) float32 where each ray ends without shapes, at most `stops_m`; empty = it is not
            asked what would be counted without them.

    Returns:
        (1, v) int32: rays that met a voxel's returns (see above; without shapes, that crossed the voxel) and
        left the voxel before their end. If asked, (2, v): the second row without shapes, of the same walk.
    """
    counted: np.ndarray = _count_passes(
        origins, directions, stops_m, grid, means, precisions, crossed_stops_m, get_num_threads()
    )
    return counted


@njit(parallel=True, cache=True, nogil=True)
def _count_passes(  # type: ignore[no-untyped-def]
    origins, directions, stops_m, grid, means, precisions, crossed_stops_m, n_threads
):  # fmt: skip
    # Whole numbers: their sum is the same in any order.
    partial = np.zeros((n_threads, 2 if len(crossed_stops_m) else 1, means.shape[0]), np.int32)
    n = origins.shape[0]
    for thread in prange(n_threads):
        for ray in range(thread * n // n_threads, (thread + 1) * n // n_threads):
            crossed_m = float(crossed_stops_m[ray]) if len(crossed_stops_m) else -1.0
            _count_ray(
                origins[ray], directions[ray], (float(stops_m[ray]), crossed_m), grid, means, precisions,
                partial[thread],
            )  # fmt: skip
    return partial.sum(axis=0)


@njit(cache=True)
def _count_ray(  # type: ignore[no-untyped-def]
    origin, direction, stops_m, grid, means, precisions, passes
):  # fmt: skip
    """Add one to `passes` (1, v) of each voxel whose returns a ray meets and that it has left before its end.

    Of (2, v) the second row counts all voxels that it crosses before its second, earlier end.
    """
    (stop_m, crossed_m), (grid_origin, voxel_m, bricks, cells, occupied) = stops_m, grid
    x_voxels, y_voxels, z_voxels = bricks.shape[0] * BRICK, bricks.shape[1] * BRICK, bricks.shape[2] * BRICK
    ox, oy, oz = origin[0], origin[1], origin[2]
    dx, dy, dz = direction[0], direction[1], direction[2]
    t, t_far = clip(ox, dx, grid_origin[0], grid_origin[0] + x_voxels * voxel_m, 0.0, stop_m)
    t, t_far = clip(oy, dy, grid_origin[1], grid_origin[1] + y_voxels * voxel_m, t, t_far)
    t, t_far = clip(oz, dz, grid_origin[2], grid_origin[2] + z_voxels * voxel_m, t, t_far)
    if t >= t_far:
        return
    t_crossed = min(t_far, crossed_m) if t < crossed_m else -1.0
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
            voxel = _voxel_at(row, x, y, z, occupied, cells)
            if voxel >= 0:
                apart = 0.0
                if precisions.shape[0] > 0:
                    _, apart = _closest(
                        precisions, voxel, means[voxel, 0] - ox, means[voxel, 1] - oy, means[voxel, 2] - oz,
                        dx, dy, dz,
                    )  # fmt: skip
                if apart <= _REACH:
                    passes[0, voxel] += 1
                if nearest <= t_crossed:
                    passes[1, voxel] += 1
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
    ray, origins, directions, grid, surfaces, limits, found_surfaces
):  # fmt: skip
    """Write the surfaces of one ray, see `find_candidates`, into four arrays (k,); how many there are.

    Empty bricks are crossed in one step. All state is in scalars: the compiler keeps no array in registers.

    Args:
        ray: Number of the ray.
        origins: (n, 3) float32.
        directions: (n, 3) float32.
        grid: A `VoxelIndex`.
        surfaces: `VoxelSurfaces`.
        limits: `WalkLimits`.
        found_surfaces: range_m, voxel, opacity and cosine, each (k,), to be written.
    """
    grid_origin, voxel_m, bricks, cells, occupied = grid
    means, normals, precisions, opacities = surfaces[0], surfaces[1], surfaces[2], surfaces[3]
    near_m, far_m, most, missed_share, stop_transmittance, faintest = limits
    range_m, voxels, opacity, cosine = found_surfaces
    ny_bricks, nz_bricks = bricks.shape[1], bricks.shape[2]
    x_voxels, y_voxels, z_voxels = bricks.shape[0] * BRICK, ny_bricks * BRICK, nz_bricks * BRICK
    ox, oy, oz = origins[ray, 0], origins[ray, 1], origins[ray, 2]
    dx, dy, dz = directions[ray, 0], directions[ray, 1], directions[ray, 2]
    t, t_far = clip(ox, dx, grid_origin[0], grid_origin[0] + x_voxels * voxel_m, near_m, far_m)
    t, t_far = clip(oy, dy, grid_origin[1], grid_origin[1] + y_voxels * voxel_m, t, t_far)
    t, t_far = clip(oz, dz, grid_origin[2], grid_origin[2] + z_voxels * voxel_m, t, t_far)
    if t >= t_far:
        return 0
    x, x_step, x_next, x_length = _first_voxel(ox, dx, t, grid_origin[0], voxel_m, x_voxels)
    y, y_step, y_next, y_length = _first_voxel(oy, dy, t, grid_origin[1], voxel_m, y_voxels)
    z, z_step, z_next, z_length = _first_voxel(oz, dz, t, grid_origin[2], voxel_m, z_voxels)
    x_density, y_density, z_density = abs(dx) / voxel_m, abs(dy) / voxel_m, abs(dz) / voxel_m
    is_shaped = precisions.shape[0] > 0
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
            voxel = _voxel_at(row, x, y, z, occupied, cells)
            if voxel >= 0:
                t_out = min(min(x_next, min(y_next, z_next)), t_far)
                mx, my, mz = means[voxel, 0] - ox, means[voxel, 1] - oy, means[voxel, 2] - oz
                nx, ny, nz = normals[voxel, 0], normals[voxel, 1], normals[voxel, 2]
                alpha = float(opacities[voxel])
                slant = nx * dx + ny * dy + nz * dz
                is_planar = nx != 0.0 or ny != 0.0 or nz != 0.0
                hit = float(mx * dx + my * dy + mz * dz)
                incidence = _NO_PLANE_COSINE
                if is_shaped:
                    hit, apart = _closest(precisions, voxel, mx, my, mz, dx, dy, dz)
                    if apart > _REACH:
                        alpha *= missed_share
                    elif not is_planar:
                        alpha *= math.exp(-_FALL * apart)
                if is_planar:
                    incidence = float(abs(slant))
                    hit = float((nx * mx + ny * my + nz * mz) / slant) if incidence > 1e-6 else -1.0
                    if not is_shaped and (hit < t or hit > t_out):
                        alpha *= missed_share
                if alpha * light >= faintest:
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


@njit(parallel=True, cache=True, nogil=True)
def find_candidates(  # type: ignore[no-untyped-def]
    origins, directions, grid, surfaces, limits
):  # fmt: skip
    """The surfaces that each ray may end on, in order.

    A voxel's candidate is where the ray meets its plane (normal not 0), else where it passes its returns (or,
    without shapes, their mean) closest, kept inside the voxel. Opacity falls off towards the ends of a shape
    that is no plane; returns that are missed, or without shapes a plane that is missed inside its voxel, keep
    `missed_share` of it.

    Args:
        origins: (n, 3) float32, scene-local.
        directions: (n, 3) float32, of unit length.
        grid: A `VoxelIndex`.
        surfaces: `VoxelSurfaces`.
        limits: `WalkLimits`; k is its `most`.

    Returns:
        range_m (n, k) float32, 0 where there is none; voxel (n, k) int32, -1 where there is none;
        opacity (n, k) float32; cosine of incidence (n, k) float32; count (n,) int32.
    """
    n = origins.shape[0]
    range_m = np.zeros((n, limits.most), np.float32)
    voxels = np.full((n, limits.most), -1, np.int32)
    opacity = np.zeros((n, limits.most), np.float32)
    cosine = np.zeros((n, limits.most), np.float32)
    count = np.zeros(n, np.int32)
    for chunk in prange((n + RAYS_A_TASK - 1) // RAYS_A_TASK):
        for ray in range(chunk * RAYS_A_TASK, min(n, (chunk + 1) * RAYS_A_TASK)):
            count[ray] = walk(
                ray, origins, directions, grid, surfaces, limits,
                (range_m[ray], voxels[ray], opacity[ray], cosine[ray]),
            )  # fmt: skip
    return range_m, voxels, opacity, cosine, count
