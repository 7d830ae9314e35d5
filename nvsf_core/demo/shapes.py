"""Exact ray casting of boxes, ellipsoids and cylinders, many rays at once.

Rays are grouped in T tiles of W neighbouring rays: `origins_m` and `directions` are (T, 3, W) float32. A cone
bounds each tile. The shapes whose bounding spheres touch it are tried from near to far, for all tiles at
once; a tile is done when the next sphere begins behind all of its hits.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

TILE_RAYS = 64
"""W: large enough for long vectors, small enough for narrow cones."""
_TINY = np.float32(1e-20)


class Kind(IntEnum):
    """Kind of a shape: the points that it holds, in its own axes scaled to half sizes of 1."""

    BOX = 0
    """|x|, |y|, |z| <= 1."""
    ELLIPSOID = 1
    """x^2 + y^2 + z^2 <= 1."""
    CYLINDER = 2
    """x^2 + y^2 <= 1 and |z| <= 1, closed at both ends."""


@dataclass(frozen=True, slots=True, eq=False)
class Shapes:
    """P shapes in one frame."""

    kind: np.ndarray
    """(P,) int8, of `Kind`."""
    centre_m: np.ndarray
    """(P, 3) float32."""
    axes: np.ndarray
    """(P, 3, 3) float32, rows are the shape's own axes."""
    half_m: np.ndarray
    """(P, 3) float32, half sizes along them."""
    radius_m: np.ndarray
    """(P,) float32, of the bounding sphere."""
    material: np.ndarray
    """(P,) int16, of `street.Material`."""
    instance: np.ndarray
    """(P,) int32, number of the object that it belongs to."""


class ShapeList:
    """Collects shapes one by one."""

    def __init__(self) -> None:
        self._rows: list[tuple[Kind, np.ndarray, np.ndarray, np.ndarray, int, int]] = []

    def add(
        self,
        kind: Kind,
        centre_m: np.ndarray,
        half_m: tuple[float, float, float],
        axes: np.ndarray,
        material: int,
        instance: int,
    ) -> None:
        """Add one shape.

        Args:
            kind: Kind of the shape.
            centre_m: (3,) its centre.
            half_m: Half sizes along its own axes.
            axes: (3, 3) its own axes as rows.
            material: See `Shapes`.
            instance: See `Shapes`.
        """
        row = (kind, np.asarray(centre_m, np.float64), np.array(half_m), axes, material, instance)
        self._rows.append(row)

    def build(self) -> Shapes:
        """All shapes so far."""
        kinds, centres, halves, axes, materials, instances = zip(*self._rows, strict=True)
        half = np.stack(halves)
        # A box reaches its corner, a cylinder its rim, an ellipsoid its longest axis.
        rim = np.hypot(np.maximum(half[:, 0], half[:, 1]), half[:, 2])
        reach = np.stack([np.linalg.norm(half, axis=1), half.max(axis=1), rim], axis=1)
        kind = np.array(kinds, np.int8)
        return Shapes(
            kind=kind,
            centre_m=np.stack(centres).astype(np.float32),
            axes=np.stack(axes).astype(np.float32),
            half_m=half.astype(np.float32),
            radius_m=reach[np.arange(len(kind)), kind].astype(np.float32),
            material=np.array(materials, np.int16),
            instance=np.array(instances, np.int32),
        )


@dataclass(frozen=True, slots=True, eq=False)
class TileCones:
    """A cone around the rays of each tile."""

    apex_m: np.ndarray
    """(T, 3) float32."""
    axis: np.ndarray
    """(T, 3) float32, unit."""
    cos_angle: np.ndarray
    """(T,) float32, of the half opening angle."""
    spread_m: np.ndarray
    """(T,) float32, largest distance of a ray's origin from the apex."""


def tile_index(rows: int, columns: int, tile_rows: int) -> np.ndarray:
    """Row-major indices (T, W) of a grid of rows x columns, cut into tiles of tile_rows x W/tile_rows.

    Tiles that cross the border repeat the last row or column, so an index may appear more than once.
    """
    tile_columns = TILE_RAYS // tile_rows
    row = np.minimum(np.arange(-(-rows // tile_rows) * tile_rows), rows - 1).reshape(-1, 1, tile_rows, 1)
    column = np.minimum(np.arange(-(-columns // tile_columns) * tile_columns), columns - 1)
    return (row * columns + column.reshape(1, -1, 1, tile_columns)).reshape(-1, TILE_RAYS)


def tile_select(values: np.ndarray, tiles: np.ndarray) -> np.ndarray:
    """Values (N, 3) of the rays of each tile: (T, 3, W) float32, for ray indices `tiles` (T, W)."""
    selected: np.ndarray = np.moveaxis(np.asarray(values, np.float32).T[:, tiles], 0, 1)
    return np.ascontiguousarray(selected)


def tile_cones(origins_m: np.ndarray, directions: np.ndarray) -> TileCones:
    """Bounding cones of tiles of rays (T, 3, W), (T, 3, W)."""
    apex = origins_m.mean(axis=2)
    axis = directions.mean(axis=2)
    axis /= np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), _TINY)
    cosine = np.einsum("tcw,tc->tw", directions, axis).min(axis=1)
    spread = np.sqrt(np.square(origins_m - apex[:, :, None]).sum(axis=1).max(axis=1))
    return TileCones(apex, axis, np.clip(cosine - 1e-6, -1.0, 1.0).astype(np.float32), spread)


def candidates(
    cones: TileCones, centre_m: np.ndarray, radius_m: np.ndarray, reach_m: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pairs (tile, sphere) that may meet within `reach_m`.

    A sphere's centre c along the axis and s across it is at least s cos a - c sin a away from the cone of
    half angle a: where that exceeds its radius no ray of the tile can meet it.

    Args:
        cones: Of T tiles.
        centre_m: (P, 3) centres of the spheres.
        radius_m: (P,) their radii.
        reach_m: Longest range that matters.

    Returns:
        tile, sphere and lower_bound_m, a range before which they cannot meet; each (K,), sorted by tile and
        then by bound.
    """
    along = cones.axis @ centre_m.T - np.sum(cones.axis * cones.apex_m, axis=1)[:, None]
    square = (
        np.sum(centre_m**2, axis=1)
        - 2.0 * cones.apex_m @ centre_m.T
        + np.sum(cones.apex_m**2, axis=1)[:, None]
    )
    distance = np.sqrt(np.maximum(square, 0.0))
    across = np.sqrt(np.maximum(square - along**2, 0.0))
    sine = np.sqrt(1.0 - cones.cos_angle**2)
    # Two millimetres cover float32's rounding at 100 m.
    radius = radius_m[None, :] + cones.spread_m[:, None] + 2e-3
    bound = distance - radius
    touch = (across * cones.cos_angle[:, None] - along * sine[:, None] <= radius) & (bound < reach_m)
    # Cones narrower than a right angle cannot reach a sphere that lies wholly behind.
    touch &= (along > -radius) | (cones.cos_angle[:, None] < 0.5)
    tile, sphere = np.nonzero(touch)
    bound = bound[tile, sphere]
    order = np.lexsort((bound, tile))
    return tile[order], sphere[order], bound[order]


def near_to_far(tile: np.ndarray, bound_m: np.ndarray, best_m: np.ndarray) -> Iterator[np.ndarray]:
    """Rounds of pairs to try: in each the next nearest pair of every tile, unless the tile is done.

    Args:
        tile: (K,) tiles of pairs, as `candidates` sorts them.
        bound_m: (K,) range before which a pair cannot meet.
        best_m: (T, W) ranges of the hits so far; read anew for each round.

    Yields:
        Indices of pairs, at least one, no tile twice.
    """
    first = np.flatnonzero(np.diff(tile, prepend=-1))
    rank = np.arange(len(tile)) - np.repeat(first, np.diff(first, append=len(tile)))
    for step in range(int(rank.max(initial=-1)) + 1):
        now = np.flatnonzero(rank == step)
        now = now[bound_m[now] < best_m[tile[now]].max(axis=1)]
        if len(now):
            yield now


def cast_shapes(
    shapes: Shapes,
    origins_m: np.ndarray,
    directions: np.ndarray,
    range_m: np.ndarray,
    cones: TileCones,
) -> tuple[np.ndarray, np.ndarray]:
    """First hits of tiles of rays on shapes, where they are nearer than the hits so far.

    Args:
        shapes: P shapes in the rays' frame.
        origins_m: (T, 3, W) float32, outside all shapes.
        directions: (T, 3, W) float32, unit.
        range_m: (T, W) float32, range of the hits so far; inf = no hit.
        cones: Of the same tiles.

    Returns:
        `range_m` (T, W) float32 and `shape` (T, W) int32, -1 where no shape is nearer.
    """
    best = range_m.copy()
    shape = np.full(best.shape, -1, np.int32)
    for kind in Kind:
        members = np.flatnonzero(shapes.kind == kind)
        farthest = best.max(axis=1)
        reach = float(farthest.max(initial=0.0))
        tile, member, bound = candidates(cones, shapes.centre_m[members], shapes.radius_m[members], reach)
        keep = bound < farthest[tile]
        tile, member, bound = tile[keep], members[member[keep]], bound[keep]
        for now in near_to_far(tile, bound, best):
            _try_shapes(shapes, kind, member[now], tile[now], origins_m, directions, best, shape)
    return best, shape


def describe_hits(shapes: Shapes, shape: np.ndarray, points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Outward normals and own coordinates of points on shapes.

    Args:
        shapes: P shapes.
        shape: (N,) index of the shape that each point lies on.
        points_m: (N, 3) in the shapes' frame.

    Returns:
        `normals` (N, 3) unit, in the shapes' frame, and `local_m` (N, 3) along the shape's own axes.
    """
    axes, half, kind = shapes.axes[shape], shapes.half_m[shape], shapes.kind[shape]
    local = np.einsum("nij,nj->ni", axes, points_m - shapes.centre_m[shape])
    unit = local / half
    # A point on a box lies on the face of its largest scaled coordinate; on a cylinder, on a lid or the side.
    face = np.zeros_like(unit)
    side = np.argmax(np.abs(unit), axis=1)
    face[np.arange(len(unit)), side] = np.sign(unit[np.arange(len(unit)), side])
    round_side = unit / half
    lid = (kind == Kind.CYLINDER) & (np.abs(unit[:, 2]) > np.hypot(unit[:, 0], unit[:, 1]))
    round_side[kind == Kind.CYLINDER, 2] = 0.0
    face[lid] = np.sign(unit[lid]) * (0.0, 0.0, 1.0)
    flat = (kind == Kind.BOX) | lid
    normal = np.where(flat[:, None], face, round_side)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), _TINY)
    return np.einsum("nij,ni->nj", axes, normal), local


def _try_shapes(
    shapes: Shapes,
    kind: Kind,
    member: np.ndarray,
    tile: np.ndarray,
    origins_m: np.ndarray,
    directions: np.ndarray,
    best: np.ndarray,
    shape: np.ndarray,
) -> None:
    """Cast the rays of k tiles (each once) at one shape each; `best` and `shape` are updated in place."""
    to_unit = shapes.axes[member] / shapes.half_m[member][:, :, None]
    origin = to_unit @ (origins_m[tile] - shapes.centre_m[member][:, :, None])
    direction = to_unit @ directions[tile]
    if kind == Kind.BOX:
        near, far = _slab(origin, direction)
        found = np.where(near <= far, near, np.inf)
    elif kind == Kind.ELLIPSOID:
        found = _sphere(origin, direction)[0]
    else:
        near, far = _sphere(origin[:, :2], direction[:, :2])
        lid_near, lid_far = _slab(origin[:, 2:], direction[:, 2:])
        near, far = np.maximum(near, lid_near), np.minimum(far, lid_far)
        found = np.where(near <= far, near, np.inf)
    now = best[tile]
    nearer = (found > 0) & (found < now)
    best[tile] = np.where(nearer, found, now)
    shape[tile] = np.where(nearer, member[:, None].astype(np.int32), shape[tile])


def _slab(origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ranges (n, W) at which rays (n, C, W) enter and leave |x_c| <= 1 for all axes c."""
    inverse = 1.0 / np.where(np.abs(direction) < _TINY, _TINY, direction)
    middle = -origin * inverse
    half = np.abs(inverse)
    return (middle - half).max(axis=1), (middle + half).min(axis=1)


def _sphere(origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ranges (n, W) at which rays (n, C, W) enter and leave sum of x_c^2 <= 1; inf and -inf if they miss it.

    Computed from the closest approach: b^2 - a c would cancel for small shapes far away.
    """
    square = np.maximum(np.square(direction).sum(axis=1), _TINY)
    middle = -(origin * direction).sum(axis=1) / square
    rest = 1.0 - np.square(origin + middle[:, None] * direction).sum(axis=1)
    half = np.sqrt(np.maximum(rest, 0.0) / square)
    hit = rest > 0
    return np.where(hit, middle - half, np.inf), np.where(hit, middle + half, -np.inf)
