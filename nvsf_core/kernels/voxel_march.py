"""Walking rays through a sparse voxel grid (Amanatides and Woo's DDA), in numba.

The grid is stored in bricks of 8 x 8 x 8 cells: `bricks` holds a brick's row in `cells`, or -1;
`cells` holds the number of the voxel that a cell is of, or -1, and `occupied` as bits which cells have one;
`edges` holds how many cells an edge of the brick's voxels has, 1, 2, 4 or 8. A voxel of several cells is
crossed in one step. A ray is origin + t * direction, direction of unit length.

A voxel's returns fill it unevenly: a ray meets a plane where it crosses it, other returns where it passes
them closest, and either only within 2.5 of the returns' own standard deviations, along the plane or all
round. Else it neither sees through them nor ends there. The deviations are given as precisions (v, 6),
inverse covariances in 1/m^2: xx, xy, xz, yy, yz, zz; with (0, 6) a ray meets whatever lies in a voxel that
it crosses.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit, prange

BRICK = 8
_NO_PLANE_COSINE = 0.5
_NEVER_M = 1e300
REACH = 6.25
"""Square of the largest distance, in standard deviations of a voxel's returns, at which a ray meets them."""
_FALL = 0.1
"""At `apart` squared standard deviations off, returns that are no plane stop exp(-_FALL * apart) of what they
stop in their middle. Planes stop as much out to their ends: walls must not leak between voxels."""
_MISSED_SHARE, _BESIDE_PLANE_SHARE = 0.03, 0.5
"""Share of their opacity that returns, and a plane's, keep for a ray that misses them inside their voxel; a
plane's more, for most go on in the voxel beside."""
SOFT_M = 0.01
"""A plane that a ray misses inside its voxel, by d, stops exp(-d / SOFT_M) of what it stops else, and a ray
that misses it by more has not seen through it (decision 0057): rays that graze a road cross many voxels
above it."""
PAST_M = 0.1
"""A plane that a ray misses inside its voxel is met where it goes on, up to so far before and behind
(decision 0060)."""
RAYS_A_TASK = 256
"""Rays that one thread renders before it takes more."""


class VoxelSurfaces(NamedTuple):
    """The surface in each of v voxels."""

    mean_m: np.ndarray
    """(v, 3) float32, scene-local."""
    normal: np.ndarray
    """(v, 3) float32; 0 where the returns are no plane."""
    precision: np.ndarray
    """(v, 6) float32, of planes along them alone; (0, 6) where no extents are known."""
    opacity: np.ndarray
    """(v,) float32."""
    intensity: np.ndarray
    """(v,) float32."""
    hits: np.ndarray
    """(v,) int32."""


class WalkLimits(NamedTuple):
    """Where a walk begins and ends."""

    near_m: float
    far_m: float
    most: int
    """Surfaces after which the walk ends."""
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
def first_voxel(origin, direction, t, grid_origin, voxel_m, voxels):  # type: ignore[no-untyped-def]
    """Along one axis at distance t: voxel, its step, distance to its border, distance between borders.

    Args:
        origin: Of the ray, along the axis, metres.
        direction: Of the ray, along the axis.
        t: Distance along the ray, metres.
        grid_origin: Of the grid, along the axis, metres.
        voxel_m: Edge of a voxel.
        voxels: Number of voxels along the axis.
    """
    index = min(max(math.floor((origin + t * direction - grid_origin) / voxel_m), 0), voxels - 1)
    if direction > 0.0:
        return index, 1, (grid_origin + (index + 1) * voxel_m - origin) / direction, voxel_m / direction
    if direction < 0.0:
        return index, -1, (grid_origin + index * voxel_m - origin) / direction, voxel_m / -direction
    # Never reached; times 0 it must not become NaN.
    return index, 1, _NEVER_M, 0.0


@njit(inline="always")
def voxel_at(row, x, y, z, occupied, cells):  # type: ignore[no-untyped-def]
    """A voxel's number, or -1 in most: their bits lie in a nearer cache than their numbers would.

    Args:
        row: Of the voxel's brick in `occupied` and `cells`.
        x: Grid coordinate of the voxel.
        y: As x.
        z: As x.
        occupied: Bits of the bricks' voxels, see `VoxelIndex`.
        cells: Numbers of the bricks' voxels.
    """
    within = ((y & 7) << 3) | (z & 7)
    is_there = (occupied[row, x & 7] >> np.uint64(within)) & np.uint64(1) != np.uint64(0)
    return cells[row, ((x & 7) << 6) | within] if is_there else np.int32(-1)


@njit(inline="always")
def _left(index, step, last):  # type: ignore[no-untyped-def]
    """Cells that are left in the cube along one axis."""
    return last - (index & last) if step > 0 else index & last


@njit(inline="always")
def _steps_before(leave, t_next, borders_a_metre, left):  # type: ignore[no-untyped-def]
    """Borders along one axis that are crossed before `leave`, of those inside the cube."""
    if t_next >= leave:
        return 0
    return min(left, int((leave - t_next) * borders_a_metre) + 1)


# Wide: five numbers an axis, as scalars, which the compiler keeps in registers.
@njit(inline="always")
def cross_cube(  # type: ignore[no-untyped-def]
    last, x, x_step, x_next, x_length, x_density, y, y_step, y_next, y_length, y_density,
    z, z_step, z_next, z_length, z_density,
):  # fmt: skip
    """Cell and next border along each axis in the last cell, of a brick or voxel, that the ray crosses.

    Args:
        last: Cells along an edge of the brick or voxel, less one: 1, 3 or 7.
        x: Grid coordinate of the cell in which the ray is.
        x_step: By how many cells it goes on along x, 1 or -1.
        x_next: Metres along the ray to the next border.
        x_length: Metres along the ray between two borders.
        x_density: Borders a metre.
        y: As of x.
        y_step: As of x.
        y_next: As of x.
        y_length: As of x.
        y_density: As of x.
        z: As of x.
        z_step: As of x.
        z_next: As of x.
        z_length: As of x.
        z_density: As of x.
    """
    x_left, y_left, z_left = _left(x, x_step, last), _left(y, y_step, last), _left(z, z_step, last)
    leave = min(x_next + x_left * x_length, min(y_next + y_left * y_length, z_next + z_left * z_length))
    x_steps = _steps_before(leave, x_next, x_density, x_left)
    y_steps = _steps_before(leave, y_next, y_density, y_left)
    z_steps = _steps_before(leave, z_next, z_density, z_left)
    return (
        x + x_steps * x_step, x_next + x_steps * x_length,
        y + y_steps * y_step, y_next + y_steps * y_length,
        z + z_steps * z_step, z_next + z_steps * z_length,
    )  # fmt: skip


@njit(inline="always")
def _squared(precisions, voxel, ex, ey, ez):  # type: ignore[no-untyped-def]
    """e^T P e of an offset e, metres, and a voxel's precision P: squares of the returns' deviation."""
    xx, xy, xz = precisions[voxel, 0], precisions[voxel, 1], precisions[voxel, 2]
    yy, yz, zz = precisions[voxel, 3], precisions[voxel, 4], precisions[voxel, 5]
    return xx * ex * ex + yy * ey * ey + zz * ez * ez + 2.0 * (xy * ex * ey + xz * ex * ez + yz * ey * ez)


# Wide: vectors are passed as scalars, which the compiler keeps in registers.
@njit(inline="always")
def _closest(precisions, voxel, mx, my, mz, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Where a ray passes a voxel's returns closest, and how close, in squares of their standard deviation.

    With precision P, mean m from the ray's origin and direction d: the t that minimises
    (m - t d)^T P (m - t d). It is sought from the foot of the mean on the ray, near which float32 is fine.

    Args:
        precisions: (v, 6) float32.
        voxel: Number of the voxel.
        mx: Mean of its returns from the ray's origin, metres, along x.
        my: Along y.
        mz: Along z.
        dx: Direction of the ray along x.
        dy: Along y.
        dz: Along z.
    """
    xx, xy, xz = precisions[voxel, 0], precisions[voxel, 1], precisions[voxel, 2]
    yy, yz, zz = precisions[voxel, 3], precisions[voxel, 4], precisions[voxel, 5]
    foot = mx * dx + my * dy + mz * dz
    ex, ey, ez = mx - foot * dx, my - foot * dy, mz - foot * dz
    px, py, pz = xx * dx + xy * dy + xz * dz, xy * dx + yy * dy + yz * dz, xz * dx + yz * dy + zz * dz
    onward = (px * ex + py * ey + pz * ez) / (px * dx + py * dy + pz * dz)
    ex, ey, ez = ex - onward * dx, ey - onward * dy, ez - onward * dz
    return float(foot + onward), _squared(precisions, voxel, ex, ey, ez)


# Wide: vectors are passed as scalars, which the compiler keeps in registers.
@njit(inline="always")
def meet(means, normals, precisions, voxel, ox, oy, oz, dx, dy, dz, t_in, t_out):  # type: ignore[no-untyped-def]
    """Where a ray meets the returns in a voxel that it crosses, and by how much it misses them.

    Args:
        means: (v, 3) float32: mean of each voxel's returns, of a plane a point on it, metres.
        normals: (v, 3) float32; 0 where the returns are no plane.
        precisions: (v, 6) or (0, 6) float32.
        voxel: Number of the voxel.
        ox: Origin of the ray along x, metres.
        oy: Along y.
        oz: Along z.
        dx: Direction of the ray along x.
        dy: Along y.
        dz: Along z.
        t_in: Where the ray enters the voxel, metres along it.
        t_out: Where it leaves it.

    Returns:
        Metres along the ray, inside the voxel or, on a plane that is missed there, at most `PAST_M` beside
        it; by how many metres the ray misses the plane inside the voxel, 0 without a plane; how far it passes
        from the mean, in squares of the returns' standard deviation; cosine of the angle between ray and
        normal, -1 without a plane.
    """
    mx, my, mz = means[voxel, 0] - ox, means[voxel, 1] - oy, means[voxel, 2] - oz
    nx, ny, nz = normals[voxel, 0], normals[voxel, 1], normals[voxel, 2]
    has_extents = precisions.shape[0] > 0
    if nx == 0.0 and ny == 0.0 and nz == 0.0:
        at, apart = float(mx * dx + my * dy + mz * dz), 0.0
        if has_extents:
            at, apart = _closest(precisions, voxel, mx, my, mz, dx, dy, dz)
        return min(max(at, t_in), t_out), 0.0, apart, -1.0
    across, slant = float(nx * mx + ny * my + nz * mz), float(nx * dx + ny * dy + nz * dz)
    plane = across / slant if abs(slant) > 1e-6 else t_in
    at = min(max(plane, t_in), t_out)
    first, last = across - slant * t_in, across - slant * t_out
    # On one side of the plane all the way.
    off_m = min(abs(first), abs(last)) if first * last > 0.0 else 0.0
    apart = 0.0
    if has_extents:
        ex, ey, ez = mx - at * dx, my - at * dy, mz - at * dz
        apart = _squared(precisions, voxel, ex, ey, ez)
    return min(max(plane, at - PAST_M), at + PAST_M), off_m, apart, abs(slant)


@njit(cache=True)
def walk(  # type: ignore[no-untyped-def]
    ray, origins, directions, grid, surfaces, limits, found_surfaces
):  # fmt: skip
    """Write the surfaces of one ray, see `find_candidates`, into four arrays (k,); how many there are.

    Empty bricks and voxels of several cells are crossed in one step. All state is in scalars: the compiler
    keeps no array in registers.

    Args:
        ray: Number of the ray.
        origins: (n, 3) float32.
        directions: (n, 3) float32.
        grid: A `VoxelIndex`.
        surfaces: `VoxelSurfaces`.
        limits: `WalkLimits`.
        found_surfaces: range_m, voxel, opacity and cosine, each (k,), to be written.
    """
    grid_origin, voxel_m, bricks, cells, occupied, edges = grid
    means, normals, precisions, opacities = surfaces[0], surfaces[1], surfaces[2], surfaces[3]
    near_m, far_m, most, stop_transmittance, faintest = limits
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
    x, x_step, x_next, x_length = first_voxel(ox, dx, t, grid_origin[0], voxel_m, x_voxels)
    y, y_step, y_next, y_length = first_voxel(oy, dy, t, grid_origin[1], voxel_m, y_voxels)
    z, z_step, z_next, z_length = first_voxel(oz, dz, t, grid_origin[2], voxel_m, z_voxels)
    x_density, y_density, z_density = abs(dx) / voxel_m, abs(dy) / voxel_m, abs(dz) / voxel_m
    light, reached = 1.0, near_m
    found = 0
    while True:
        row = bricks[x >> 3, y >> 3, z >> 3]
        last = edges[row] - 1 if row >= 0 else (BRICK << (-1 - row)) - 1
        if last > 0:
            x, x_next, y, y_next, z, z_next = cross_cube(
                last, x, x_step, x_next, x_length, x_density, y, y_step, y_next, y_length, y_density,
                z, z_step, z_next, z_length, z_density,
            )  # fmt: skip
        if row >= 0:
            voxel = voxel_at(row, x, y, z, occupied, cells)
            if voxel >= 0:
                t_out = min(min(x_next, min(y_next, z_next)), t_far)
                at, off_m, apart, incidence = meet(
                    means, normals, precisions, voxel, ox, oy, oz, dx, dy, dz, t, t_out
                )  # fmt: skip
                # Planes that go on beside their voxels stay in the voxels' order.
                reached = min(max(at, reached), far_m)
                alpha = float(opacities[voxel])
                if incidence < 0.0:
                    alpha *= math.exp(-_FALL * apart) if apart <= REACH else _MISSED_SHARE
                    incidence = _NO_PLANE_COSINE
                else:
                    if off_m > 0.0:
                        alpha *= math.exp(-off_m / SOFT_M)
                    if apart > REACH:
                        alpha *= _BESIDE_PLANE_SHARE
                if alpha * light >= faintest:
                    range_m[found] = reached
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

    A voxel's candidate is where the ray meets its plane (normal not 0), inside the voxel or a little beside
    it; else where it passes its returns (or, without extents, their mean) closest, kept inside the voxel.
    Opacity falls off from the middle of returns that are no plane, and with the distance by which a plane is
    missed inside its voxel; beyond their ends little is left of the ones, half of the others.

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
