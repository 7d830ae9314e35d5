"""The residual LiDAR field: it corrects the surfaces that the evidence has along rays, static and moving.

Its features are decoded once a ray.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from nvsf_core.evidence.moving.object_evidence import MovingObject, ObjectEvidence
from nvsf_core.evidence.moving.objects import ObjectSurfels, candidates_on
from nvsf_core.evidence.surfels import Surfels
from nvsf_core.fields.layers import network
from nvsf_core.geometry.bounds import Bounds
from nvsf_core.kernels.encodings.hash_grid import HashGrid, grid_layout
from nvsf_core.kernels.surface_list import N_FACTS, list_surfaces
from nvsf_core.recipe.residual import FieldSpec

_STOP_TRANSMITTANCE, _FAINTEST = 0.02, 0.005
"""Limits of a field's rays, see `WalkLimits`. What lies behind nearly all of the light, or stops hardly any,
is a seventh to a sixth of all surfaces, and correcting it made no error smaller (docs/lean_trials.md)."""


def object_places(paths: tuple[MovingObject, ...], bounds: Bounds, gap_m: float) -> np.ndarray:
    """Where in the field's cube the corrections of each moving object are stored.

    Shifts (n, 3) float64, metres, from each object's own frame. Objects must overlap neither the street nor
    each other. They are placed in rows under the cube's top, which is empty because a street is not as high
    as it is wide; the next layer is below. When the cube is full, places are reused from the top. Between two
    objects there is a cell of the coarsest level, `gap_m`.
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
    return corner + steps * pitch_m - middle_m


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
    place: Tensor
    """(m,) int64: where each surface stands in `is_there`, flattened."""
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
        full = values.new_zeros(self.is_there.numel(), values.shape[1])
        full = full.scatter(0, self.place[:, None].expand_as(values), values)
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
        surfels: The static evidence; surfaces that hardly count are left out (`_FAINTEST`).
        origin_m: (r, 3) scene-local.
        direction: (r, 3) unit vectors, scene-local.
        most: Surfaces a ray; of more, the farthest are left out.
        near_m: Least range.
        far_m: Largest range.
        objects: `object_surfaces` of the same rays; None = no moving objects.
    """
    met = NO_SURFACES if objects is None else objects
    towards = np.ascontiguousarray(direction, np.float32)
    limits = surfels.walk_limits(
        near_m, far_m, most, stop_transmittance=_STOP_TRANSMITTANCE, faintest=_FAINTEST
    )
    first, range_m, logit, facts, point_m, hit_prior = list_surfaces(
        np.ascontiguousarray(origin_m, np.float32), towards, surfels.index, surfels.surfaces,
        limits, met,
    )  # fmt: skip
    count = np.diff(first)
    step = np.arange(max(1, int(count.max(initial=1))))
    is_there = step < count[:, None]
    return SurfaceBatch(
        direction=torch.from_numpy(towards),
        first=torch.from_numpy(first),
        is_there=torch.from_numpy(is_there),
        place=torch.from_numpy(np.flatnonzero(is_there)),
        point_m=torch.from_numpy(point_m),
        range_m=torch.from_numpy(range_m),
        logit=torch.from_numpy(logit),
        facts=torch.from_numpy(facts),
        hit_prior=torch.from_numpy(hit_prior),
    )


class LidarField(nn.Module):
    """Corrections of each surface's opacity and range, 0 before training: it starts from the evidence."""

    def __init__(self, spec: FieldSpec, bounds: Bounds, generator: torch.Generator) -> None:
        """Sample all weights from `generator`."""
        super().__init__()
        self.spec = spec
        self.bounds = bounds
        layout = grid_layout(spec, bounds.edge_m)
        self.grid = HashGrid(layout, generator)
        self.density = network(
            (layout.outputs + N_FACTS, spec.hidden, 2 + spec.decoded), generator, zero_outputs=2
        )
        self.hit_head = network((spec.decoded + 8, spec.decoder_hidden, 1), generator, zero_outputs=1)
        self.intensity_head = network((spec.decoded + 8, spec.decoder_hidden, 1), generator, zero_outputs=1)

    @classmethod
    def around(cls, points_m: np.ndarray, spec: FieldSpec, generator: torch.Generator) -> "LidarField":
        """An untrained field in the smallest cube around points (n, 3), scene-local metres, with a margin."""
        low_m, high_m = points_m.min(axis=0), points_m.max(axis=0)
        return cls(spec, Bounds.around(tuple(low_m.tolist()), tuple(high_m.tolist())), generator)

    def places(self, objects: tuple[ObjectEvidence, ...]) -> np.ndarray:
        """`object_places` (n, 3) in this field's cube, metres, of a scene's moving objects."""
        paths = tuple(one.path for one in objects)
        return object_places(paths, self.bounds, self.spec.coarsest_cell_m)

    def surfaces(self, batch: SurfaceBatch) -> tuple[Tensor, Tensor, Tensor]:
        """Corrected opacity logit (m,), range_m (m,), and features (m, d) of a batch's m surfaces."""
        encoded = self.grid(self.bounds.to_unit(batch.point_m).clamp_(0.0, 1.0))
        raw = self.density(torch.cat([encoded, batch.facts], dim=1))
        shift_m = self.spec.max_shift_m * torch.tanh(raw[:, 1])
        return batch.logit + raw[:, 0], batch.range_m + shift_m, raw[:, 2:]

    def decode(self, ray: Tensor) -> tuple[Tensor, Tensor]:
        """Corrections of hit logit and intensity logit, (r,) each, from composited features (r, d + 8)."""
        return self.hit_head(ray)[:, 0], self.intensity_head(ray)[:, 0]
