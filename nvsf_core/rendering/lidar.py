"""How the field answers a LiDAR ray."""

from dataclasses import dataclass

import torch
from torch import Tensor

from nvsf_core.fields.lidar_field import LidarField
from nvsf_core.fields.surface_batch import SurfaceBatch
from nvsf_core.rendering.accumulate import value_at, weighted_median_index
from nvsf_core.rendering.answers import RayAnswers
from nvsf_core.rendering.weights import weights_from_opacity_logits

_VOTE_LIMIT = 0.02


@dataclass(frozen=True, slots=True)
class LidarRender:
    """A rendered batch of r rays with k surfaces, differentiable."""

    weights: Tensor
    """(r, k): share of the ray that ends on each surface; rows sum to at most 1."""
    range_m: Tensor
    """(r, k): where the surfaces lie."""
    hit_logit: Tensor
    """(r,)."""
    intensity_logit: Tensor
    """(r,)."""


def render_lidar(field: LidarField, batch: SurfaceBatch, vote: Tensor) -> LidarRender:
    """Composite a ray's surfaces, then decode hit and intensity once.

    Args:
        field: The scene.
        batch: Rays and proposed surfaces.
        vote: (r,) share of the nearest training scans that returned here: the prior of the hit.
    """
    logit, range_m, features = field.surfaces(batch)
    weights, _ = weights_from_opacity_logits(torch.where(batch.is_there, logit, -torch.inf))
    total = weights.sum(dim=1)
    share = weights / total.clamp_min(torch.finfo(weights.dtype).eps)[:, None]
    intensity = (share * batch.intensity).sum(dim=1)
    prior_hit = torch.logit(vote.clamp(_VOTE_LIMIT, 1 - _VOTE_LIMIT))
    prior_intensity = torch.logit(intensity.clamp(0.01, 0.99))
    ray = torch.cat(
        [
            (weights[..., None] * features).sum(dim=1),
            total[:, None],
            (share * range_m).sum(dim=1, keepdim=True) / 50.0,
            (share * batch.cosine).sum(dim=1, keepdim=True),
            intensity[:, None],
            batch.direction,
            prior_hit[:, None] / 4.0,
        ],
        dim=1,
    )
    hit, brightness = field.decode(ray)
    return LidarRender(weights, range_m, prior_hit + hit, prior_intensity + brightness)


@torch.no_grad()
def answer_rays(field: LidarField, batch: SurfaceBatch, vote: Tensor) -> RayAnswers:
    """The weighted median surface, the hit probability and the intensity of each ray."""
    rendered = render_lidar(field, batch, vote)
    range_m = value_at(rendered.range_m, weighted_median_index(rendered.weights))
    answered = batch.is_there[:, 0]
    return RayAnswers(
        range_m=torch.where(answered, range_m, torch.inf).numpy(),
        hit=torch.where(answered, torch.sigmoid(rendered.hit_logit), 0.0).numpy(),
        intensity=torch.sigmoid(rendered.intensity_logit).numpy(),
    )
