"""Rays with the surfaces that evidence proposes for them, static and of moving objects: a field's input."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from nvsf_core.evidence.moving.objects import ObjectSurfels, candidates_on
from nvsf_core.evidence.moving.rigid_path import MovingObject
from nvsf_core.evidence.static.surfels import Surfels
from nvsf_core.geometry.bounds import Bounds
from nvsf_core.kernels.surface_list import list_surfaces


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


class ObjectSurfaces(NamedTuple):
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


_COLUMNS = ObjectSurfaces._fields[2:]


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


@dataclass(frozen=True, slots=True)
class SurfaceBatch:
    """r rays with at most k of m proposed surfaces each, one ray after the other, scene-local metres."""

    direction: Tensor
    """(r, 3)."""
    first: Tensor
    """(r + 1,) int64: where each ray's surfaces begin, ascending in range."""
    is_there: Tensor
    """(r, k) bool: as many as the ray has."""
    point_m: Tensor
    """(m, 3): where a surface's corrections lie: itself, a moving object's surface at its place."""
    range_m: Tensor
    """(m,)."""
    logit: Tensor
    """(m,): logit of the evidence's opacity."""
    facts: Tensor
    """(m, 6): opacity logit, cosine of incidence, planar?, log hits, intensity, range; about 0..1."""
    hit_prior: Tensor
    """(m,): share of a moving object's nearest scans that returned there; negative on what stands."""

    def spread(self, values: Tensor) -> Tensor:
        """Values (m, c) of all surfaces as (r, k, c), 0 behind a ray's last."""
        rows = self.is_there.view(-1).nonzero()
        full = values.new_zeros(self.is_there.numel(), values.shape[1])
        full = full.scatter(0, rows.expand_as(values), values)
        return full.view(*self.is_there.shape, values.shape[1])


def surface_batch(
    surfels: Surfels,
    origin_m: np.ndarray,
    direction: np.ndarray,
    *,
    most: int,
    near_m: float,
    far_m: float,
    objects: ObjectSurfaces | None = None,
) -> SurfaceBatch:
    """Walk rays (r, 3) through the evidence of what stands; `objects` of the same rays are merged by range.

    Where there are more than `most` surfaces the farthest are left out.
    """
    met = NO_SURFACES if objects is None else objects
    towards = np.ascontiguousarray(direction, np.float32)
    first, range_m, logit, facts, point_m, hit_prior = list_surfaces(
        np.ascontiguousarray(origin_m, np.float32), towards, surfels.index, surfels.surfaces,
        surfels.walk_limits(near_m, far_m, most), met,
    )  # fmt: skip
    count = np.diff(first)
    step = np.arange(max(1, int(count.max(initial=1))))
    return SurfaceBatch(
        direction=torch.from_numpy(towards),
        first=torch.from_numpy(first),
        is_there=torch.from_numpy(step < count[:, None]),
        point_m=torch.from_numpy(point_m),
        range_m=torch.from_numpy(range_m),
        logit=torch.from_numpy(logit),
        facts=torch.from_numpy(facts),
        hit_prior=torch.from_numpy(hit_prior),
    )
