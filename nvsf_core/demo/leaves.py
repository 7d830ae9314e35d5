"""The demo's tree crowns: balls of leaves in a grid, at most one a cell, so that rays find them exactly."""

from dataclasses import dataclass

import numpy as np

from nvsf_core.demo.shapes import TileCones, candidates, near_to_far

GRID_CELLS = 16
"""Cells of a crown's grid along each axis."""
_BALL_SHARE = 0.17
"""Share of the cells inside a crown that hold a ball: a ray crosses about 3 m of crown without a hit."""


@dataclass(frozen=True, slots=True, eq=False)
class Crowns:
    """C crowns with the same foliage, each with a rotation and a scale of its own."""

    centre_m: np.ndarray
    """(C, 3) float32."""
    axes: np.ndarray
    """(C, 3, 3) float32, rows are the grid's axes."""
    radius_m: np.ndarray
    """(C,) float32, of the sphere inside the grid's cube."""
    instance: np.ndarray
    """(C,) int32, number of the tree."""
    foliage: np.ndarray
    """(cells, cells, cells, 4) float32: centre and radius of each cell's ball, in cells; radius 0 = none."""


def make_foliage(rng: np.random.Generator) -> np.ndarray:
    """Sample the balls of a crown in cells of an uneven sphere, each inside its cell.

    Returns:
        (cells, cells, cells, 4) float32, as `Crowns.foliage`.
    """
    shape = (GRID_CELLS,) * 3
    radius = rng.uniform(0.28, 0.48, shape)
    corner = np.stack(np.meshgrid(*[np.arange(GRID_CELLS)] * 3, indexing="ij"), axis=-1)
    # The jitter keeps every ball inside its cell, so the first ball along a ray is the nearest.
    jitter = rng.uniform(-1.0, 1.0, (*shape, 3)) * (0.5 - radius[..., None])
    centre = corner + 0.5 + jitter
    away = (centre - GRID_CELLS / 2) / (GRID_CELLS / 2)
    waves = np.sin(away * (5.0, 6.0, 5.0) + (1.0, 0.0, 0.0)).prod(axis=-1)
    reach = np.linalg.norm(away, axis=-1)
    # As in real trees, the outer half is three times as dense as the middle.
    share = _BALL_SHARE * np.where(reach > 0.55, 1.3, 0.45)
    present = (reach < 0.84 + 0.1 * waves) & (rng.random(shape) < share)
    foliage: np.ndarray = np.concatenate([centre, np.where(present, radius, 0.0)[..., None]], axis=-1)
    return foliage.astype(np.float32)


def cast_crowns(
    crowns: Crowns,
    origins_m: np.ndarray,
    directions: np.ndarray,
    range_m: np.ndarray,
    cones: TileCones,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """First hits of tiles of rays on leaves, where they are nearer than the hits so far.

    Args:
        crowns: C crowns in the rays' frame.
        origins_m: (T, 3, W) float32.
        directions: (T, 3, W) float32, unit.
        range_m: (T, W) float32, range of the hits so far; inf = no hit.
        cones: Of the same tiles.

    Returns:
        `range_m` (T, W), `crown` (T, W) int32 or -1, `normals` (T, 3, W), 0 where no leaf is nearer.
    """
    best = range_m.copy()
    crown = np.full(best.shape, -1, np.int32)
    normals = np.zeros_like(directions)
    reach = float(best.max(initial=0.0))
    tile, member, bound = candidates(cones, crowns.centre_m, crowns.radius_m, reach)
    for now in near_to_far(tile, bound, best):
        _try_crowns(crowns, tile[now], member[now], origins_m, directions, best, crown, normals)
    return best, crown, normals


def _try_crowns(
    crowns: Crowns,
    tile: np.ndarray,
    member: np.ndarray,
    origins_m: np.ndarray,
    directions: np.ndarray,
    best: np.ndarray,
    crown: np.ndarray,
    normals: np.ndarray,
) -> None:
    """Cast the rays of k tiles (each once) at one crown each; the last three arguments change in place."""
    to_grid = crowns.axes[member] / (crowns.radius_m[member] * (2.0 / GRID_CELLS))[:, None, None]
    origin = to_grid @ (origins_m[tile] - crowns.centre_m[member][:, :, None])
    direction = to_grid @ directions[tile]
    square = np.square(direction).sum(axis=1)
    middle = -(origin * direction).sum(axis=1) / square
    rest = (GRID_CELLS / 2) ** 2 - np.square(origin + middle[:, None] * direction).sum(axis=1)
    half = np.sqrt(np.maximum(rest, 0.0) / square)
    near, far = np.maximum(middle - half, 0.0), np.minimum(middle + half, best[tile])
    pair, ray = np.nonzero((rest > 0) & (near < far))
    if len(pair) == 0:
        return
    found, normal = _walk(
        crowns.foliage,
        origin[pair, :, ray] + np.float32(GRID_CELLS / 2),
        direction[pair, :, ray],
        near[pair, ray],
        far[pair, ray],
    )
    hit = np.isfinite(found)
    pair, ray, found, normal = pair[hit], ray[hit], found[hit], normal[hit]
    best[tile[pair], ray] = found
    crown[tile[pair], ray] = member[pair]
    normals[tile[pair], :, ray] = np.einsum("nij,ni->nj", crowns.axes[member[pair]], normal)


def _walk(
    foliage: np.ndarray, origin: np.ndarray, direction: np.ndarray, near: np.ndarray, far: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Range (N,), inf without a hit, and normal (N, 3) of the first ball along rays (N, 3), in cells.

    Rays are followed from `near` to `far` cell by cell: J. Amanatides, A. Woo, "A Fast Voxel Traversal
    Algorithm for Ray Tracing", Eurographics 1987.
    """
    found = np.full(len(near), np.inf, np.float32)
    normal = np.zeros((len(near), 3), np.float32)
    direction = np.where(np.abs(direction) < 1e-9, np.float32(1e-9), direction)
    start = origin + near[:, None] * direction
    cell = np.clip(np.floor(start).astype(np.int32), 0, GRID_CELLS - 1)
    step = np.where(direction > 0, 1, -1).astype(np.int32)
    delta = np.abs(1.0 / direction)
    border = (cell + (step > 0) - origin) / direction
    active = np.arange(len(near))
    table = foliage.reshape(-1, 4)
    scale = np.array([GRID_CELLS**2, GRID_CELLS, 1], np.int32)
    for _ in range(3 * GRID_CELLS + 2):
        ball = table[cell @ scale]
        full = np.flatnonzero(ball[:, 3] > 0)
        if len(full):
            at, towards = _meet_balls(ball[full], origin[active[full]], direction[active[full]])
            met = (at > near[active[full]] * 0.999) & (at < far[active[full]])
            found[active[full[met]]] = at[met]
            normal[active[full[met]]] = towards[met]
        axis = np.argmin(border, axis=1)
        rows = np.arange(len(active))
        now = border[rows, axis]
        cell[rows, axis] += step[rows, axis]
        border[rows, axis] += delta[rows, axis]
        on = (now < far[active]) & (cell[rows, axis] >= 0) & (cell[rows, axis] < GRID_CELLS)
        on &= ~np.isfinite(found[active])
        if not on.all():
            active, cell, border = active[on], cell[on], border[on]
            step, delta = step[on], delta[on]
        if len(active) == 0:
            break
    return found, normal


def _meet_balls(ball: np.ndarray, origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Range (N,) of rays (N, 3) at which they enter balls (N, 4), inf if missed, and outward unit normals."""
    relative = origin - ball[:, :3]
    square = np.square(direction).sum(axis=1)
    middle = -(relative * direction).sum(axis=1) / square
    rest = ball[:, 3] ** 2 - np.square(relative + middle[:, None] * direction).sum(axis=1)
    at = np.where(rest > 0, middle - np.sqrt(np.maximum(rest, 0.0) / square), np.inf)
    finite = np.where(rest > 0, at, 0.0)
    return at, (relative + finite[:, None] * direction) / ball[:, 3:]
