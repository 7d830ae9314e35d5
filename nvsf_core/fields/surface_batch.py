"""Rays with the surfaces that evidence proposes for them: what both fields start from."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nvsf_core.evidence.surfels import Surfels, candidates_of

N_FACTS = 6
_LOGIT_LIMIT = 6.0


@dataclass(frozen=True, slots=True)
class SurfaceBatch:
    """r rays with at most k proposed surfaces each, scene-local metres."""

    origin_m: Tensor
    """(r, 3)."""
    direction: Tensor
    """(r, 3)."""
    range_m: Tensor
    """(r, k), ascending; 0 where there is no surface."""
    logit: Tensor
    """(r, k): logit of the evidence's opacity."""
    is_there: Tensor
    """(r, k) bool."""
    facts: Tensor
    """(r, k, 6): opacity logit, cosine of incidence, planar?, log hits, intensity, range; about 0..1."""

    @property
    def intensity(self) -> Tensor:
        """(r, k): the voxels' mean intensity."""
        return self.facts[..., 4]

    @property
    def cosine(self) -> Tensor:
        """(r, k): cosine of incidence."""
        return self.facts[..., 1]


def surface_batch(
    surfels: Surfels, origin_m: np.ndarray, direction: np.ndarray, *, most: int, near_m: float, far_m: float
) -> SurfaceBatch:
    """Walk rays (r, 3) through the evidence."""
    found = candidates_of(surfels, origin_m, direction, most=most, near_m=near_m, far_m=far_m)
    depth = max(1, int((found.voxel >= 0).sum(axis=1).max(initial=1)))
    voxel, opacity = found.voxel[:, :depth], found.opacity[:, :depth]
    range_m = np.ascontiguousarray(found.range_m[:, :depth])
    clipped = np.clip(opacity, 1e-6, 1 - 1e-6)
    logit = np.clip(np.log(clipped / (1 - clipped)), -_LOGIT_LIMIT, _LOGIT_LIMIT)
    facts = np.stack(
        [
            logit / _LOGIT_LIMIT,
            found.cosine[:, :depth],
            surfels.is_planar[voxel],
            np.log1p(surfels.hits[voxel]) / 5.0,
            surfels.intensity[voxel],
            range_m / 50.0,
        ],
        axis=-1,
    )
    return SurfaceBatch(
        origin_m=torch.from_numpy(np.ascontiguousarray(origin_m, np.float32)),
        direction=torch.from_numpy(np.ascontiguousarray(direction, np.float32)),
        range_m=torch.from_numpy(range_m),
        logit=torch.from_numpy(logit.astype(np.float32)),
        is_there=torch.from_numpy(voxel >= 0),
        facts=torch.from_numpy(facts.astype(np.float32)),
    )
