"""Rays with the surfaces that evidence proposes for them: what the LiDAR's field starts from."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nvsf_core.evidence.static.surfels import STOP_TRANSMITTANCE, Surfels
from nvsf_core.fields.object_surfaces import NO_SURFACES, ObjectSurfaces
from nvsf_core.kernels.surface_list import N_FACTS, list_surfaces

__all__ = ["N_FACTS", "SurfaceBatch", "surface_batch"]


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
    index, towards = surfels.index, np.ascontiguousarray(direction, np.float32)
    first, range_m, logit, facts, point_m, hit_prior = list_surfaces(
        np.ascontiguousarray(origin_m, np.float32), towards, near_m, far_m,
        index.origin_m, index.voxel_m, index.bricks, index.cells,
        surfels.mean_m, surfels.normal, surfels.precision, surfels.opacity,
        surfels.missed_share, STOP_TRANSMITTANCE, most, surfels.hits, surfels.intensity,
        met.ray, met.first, met.range_m, met.opacity, met.cosine, met.is_planar, met.hits, met.intensity,
        met.place_m, met.hit_prior,
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
