"""Surfaces of moving objects that rays may end on, each at its ray's own time and in its object's frame."""

from dataclasses import dataclass, fields

import numpy as np

from nvsf_core.evidence.moving.objects import ObjectSurfels, candidates_on
from nvsf_core.evidence.moving.rigid_path import MovingObject
from nvsf_core.geometry.bounds import Bounds


def object_places(paths: tuple[MovingObject, ...], bounds: Bounds, gap_m: float) -> np.ndarray:
    """Room for each object's corrections in the field's cube, apart from the street and from each other.

    Objects stand in rows under the cube's top, which a street, as wide as its cube but not as high, leaves
    free; the next layer lies below. Where the cube is full they begin again at the top.

    Args:
        paths: The scene's objects, in their order.
        bounds: The field's cube.
        gap_m: Space kept between two of them: a cell of the coarsest level.

    Returns:
        (n, 3) float64 shifts from each object's own frame to its place in the cube, metres.
    """
    if not paths:
        return np.zeros((0, 3))
    pitch_m = max(float((path.high_m - path.low_m).max()) for path in paths) + gap_m
    a_row = max(1, int(bounds.edge_m // pitch_m))
    column, row, layer = np.unravel_index(np.arange(len(paths)) % a_row**3, (a_row,) * 3, order="F")
    corner = np.array(bounds.centre_m) - bounds.half_m
    steps = np.stack([column, row, a_row - 1 - layer], axis=1) + 0.5
    steps[:, 2] += bounds.edge_m / pitch_m - a_row
    middle_m = np.array([0.5 * (path.low_m + path.high_m) for path in paths])
    places: np.ndarray = corner + steps * pitch_m - middle_m
    return places


@dataclass(frozen=True, slots=True)
class ObjectSurfaces:
    """t surfaces of m of the n rays of a batch: those that meet an object; ascending along each ray."""

    ray: np.ndarray
    """(m,) int64 ascending."""
    first: np.ndarray
    """(m + 1,) int64: where each such ray's surfaces begin."""
    range_m: np.ndarray
    """(t,) float32."""
    opacity: np.ndarray
    """(t,) float32."""
    cosine: np.ndarray
    """(t,) float32: cosine of incidence."""
    is_planar: np.ndarray
    """(t,) bool."""
    hits: np.ndarray
    """(t,) int32 of the surfel."""
    intensity: np.ndarray
    """(t,) float32 of the surfel."""
    hit_prior: np.ndarray
    """(t,) float32: share of the object's nearest scans that returned where the ray ends on it."""
    place_m: np.ndarray
    """(t, 3) float32: where it lies in the field's cube."""

    def of(self, chosen: np.ndarray) -> "ObjectSurfaces":
        """Surfaces of rays (r,) int64 out of the n, which become rays 0 .. r - 1."""
        if len(self.ray) == 0:
            return self
        at = np.minimum(np.searchsorted(self.ray, chosen), len(self.ray) - 1)
        ray = np.flatnonzero(self.ray[at] == chosen)
        at = at[ray]
        count = self.first[at + 1] - self.first[at]
        first = np.concatenate([[0], np.cumsum(count)])
        taken = np.repeat(self.first[at] - first[:-1], count) + np.arange(first[-1])
        columns = {name: getattr(self, name)[taken] for name in _COLUMNS}
        return ObjectSurfaces(ray, first, **columns)


_COLUMNS = tuple(column.name for column in fields(ObjectSurfaces) if column.name not in ("ray", "first"))


def object_surfaces(
    objects: tuple[ObjectSurfels, ...],
    places: np.ndarray,
    origin_m: np.ndarray,
    direction: np.ndarray,
    time_s: np.ndarray,
    *,
    near_m: float,
    far_m: float,
) -> ObjectSurfaces:
    """Walk rays (r, 3), scene-local, through each object where it is at their times (r,).

    `places` (n, 3) are `object_places` of all of the scene's objects.
    """
    rays, columns = [np.zeros(0, np.int64)], [_nothing()]
    for one in objects:
        met, found = candidates_on(one, origin_m, direction, time_s, near_m=near_m, far_m=far_m)
        there = found.voxel >= 0
        row, _ = np.nonzero(there)
        voxel, range_m, ray = found.voxel[there], found.range_m[there], met[row]
        point = origin_m[ray] + direction[ray] * range_m[:, None]
        hit_prior = one.hit_prior(found, origin_m[met], direction[met], time_s[met])
        surfels = one.surfels
        rays.append(ray)
        columns.append({
            "range_m": range_m, "opacity": found.opacity[there], "cosine": found.cosine[there],
            "is_planar": surfels.is_planar[voxel], "hits": surfels.hits[voxel],
            "intensity": surfels.intensity[voxel].astype(np.float32), "hit_prior": hit_prior[row],
            "place_m": (one.path.to_object(point, time_s[ray]) + places[one.number]).astype(np.float32),
        })  # fmt: skip
    ray = np.concatenate(rays)
    joined = {name: np.concatenate([part[name] for part in columns]) for name in _COLUMNS}
    order = np.lexsort((joined["range_m"], ray))
    met, count = np.unique(ray, return_counts=True)
    first = np.concatenate([[0], np.cumsum(count)])
    return ObjectSurfaces(met, first, **{name: column[order] for name, column in joined.items()})


def join_surfaces(parts: list[ObjectSurfaces], rays: list[int]) -> ObjectSurfaces:
    """Surfaces of batches of so many rays each, one after the other."""
    before = np.cumsum([0, *rays[:-1]])
    starts = np.cumsum([0, *(len(part.range_m) for part in parts)])
    first = [part.first[:-1] + start for part, start in zip(parts, starts[:-1], strict=True)]
    return ObjectSurfaces(
        np.concatenate([part.ray + shift for part, shift in zip(parts, before, strict=True)]),
        np.concatenate([*first, starts[-1:]]),
        **{name: np.concatenate([getattr(part, name) for part in parts]) for name in _COLUMNS},
    )


def _nothing() -> dict[str, np.ndarray]:
    none = np.zeros(0, np.float32)
    return {
        "range_m": none, "opacity": none, "cosine": none, "is_planar": np.zeros(0, bool),
        "hits": np.zeros(0, np.int32), "intensity": none, "hit_prior": none, "place_m": none.reshape(0, 3),
    }  # fmt: skip


NO_SURFACES = ObjectSurfaces(np.zeros(0, np.int64), np.zeros(1, np.int64), **_nothing())
"""Of rays that meet nothing that moves."""
