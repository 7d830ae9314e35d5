"""Rays with the surfaces that the evidence has along them, static and moving: input of the LiDAR field."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from nvsf_core.evidence.moving.objects import ObjectSurfels, candidates_on
from nvsf_core.evidence.moving.rigid_path import MovingObject
from nvsf_core.evidence.surfels import Surfels
from nvsf_core.geometry.bounds import Bounds
from nvsf_core.kernels.surface_list import list_surfaces


def object_places(paths: tuple[MovingObject, ...], bounds: Bounds, gap_m: float) -> np.ndarray:
    """Where in the field's cube the corrections of each moving object are stored.

    Objects must overlap neither the street nor each other. They are placed in rows under the cube's top,
    which is empty because a street is not as high as it is wide; the next layer is below. When the cube is
    full, places are reused from the top.

    Args:
        paths: The scene's objects, in their order.
        bounds: The field's cube.
        gap_m: Space between two objects: a cell of the coarsest level.

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
    """The t surfaces of moving objects along those m of a batch's n rays that meet one, by range."""

    ray: np.ndarray
    """(m,) int64: numbers of these rays in the batch, ascending."""
    first: np.ndarray
    """(m + 1,) int64: where each such ray's surfaces begin, and t."""
    range_m: np.ndarray
    """(t,) float32: distance from the ray's origin, ascending along each ray."""
    opacity: np.ndarray
    """(t,) float32 in 0..1."""
    cosine: np.ndarray
    """(t,) float32: cosine of incidence."""
    is_planar: np.ndarray
    """(t,) bool."""
    hits: np.ndarray
    """(t,) int32: recorded returns in the surfel."""
    intensity: np.ndarray
    """(t,) float32: the surfel's intensity, 0..1."""
    hit_prior: np.ndarray
    """(t,) float32: share of the object's nearest scans that had a return there."""
    place_m: np.ndarray
    """(t, 3) float32: position in the field's cube, see `object_places`."""

    def of(self, chosen: np.ndarray) -> "ObjectSurfaces":
        """The surfaces of the `chosen` rays (r,) int64 of the batch, renumbered 0 to r - 1."""
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
    """The surfaces of moving objects along rays, each object posed at the ray's own time.

    Args:
        objects: Surfels of the objects that the rays may meet.
        places: (n, 3) metres, `object_places` of all of the scene's objects.
        origin_m: (r, 3) scene-local.
        direction: (r, 3) unit vectors, scene-local.
        time_s: (r,) of each ray.
        near_m: Least range.
        far_m: Largest range.
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
    """The surfaces of several batches with `rays` rays each, as of one batch with all of them in order."""
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
"""Surfaces of rays that meet no moving object."""


@dataclass(frozen=True, slots=True)
class SurfaceBatch:
    """r rays with at most k surfaces each, m in all, ray by ray; scene-local, metres."""

    direction: Tensor
    """(r, 3) float32 unit vectors."""
    first: Tensor
    """(r + 1,) int64: where each ray's surfaces begin, in ascending range, and m."""
    is_there: Tensor
    """(r, k) bool: True for as many surfaces as the ray has."""
    point_m: Tensor
    """(m, 3): where the surface's corrections are stored: at its own point, or for a moving object as in
    `object_places`."""
    range_m: Tensor
    """(m,): distance from the ray's origin."""
    logit: Tensor
    """(m,): logit of the opacity in the evidence."""
    facts: Tensor
    """(m, 6): opacity logit, cosine of incidence, is planar, log of hits, intensity, range; about 0..1."""
    hit_prior: Tensor
    """(m,): share of a moving object's nearest scans that had a return there; -1 on static surfaces."""

    def to(self, device: torch.device) -> "SurfaceBatch":
        """The same batch on `device`."""
        return SurfaceBatch(*(getattr(self, name).to(device) for name in self.__slots__))

    def spread(self, values: Tensor) -> Tensor:
        """`values` (m, c) of all surfaces as (r, k, c), with 0 behind a ray's last surface."""
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
    """The surfaces along rays: static ones, merged by range with those of moving objects.

    Args:
        surfels: The static evidence.
        origin_m: (r, 3) scene-local.
        direction: (r, 3) unit vectors, scene-local.
        most: Surfaces a ray; of more, the farthest are left out.
        near_m: Least range.
        far_m: Largest range.
        objects: `object_surfaces` of the same rays; None = no moving objects.
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
