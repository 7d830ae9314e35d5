"""How the field answers a LiDAR ray."""

from dataclasses import dataclass

import torch
from torch import Tensor

from nvsf_core.fields.lidar_field import LidarField
from nvsf_core.fields.surface_batch import OnObjects, SurfaceBatch
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
        vote: (r,) share of the nearest training scans that returned here: the prior of the hit. A ray
            that ends on a moving object, by more than half, asks the object's surfaces instead.
    """
    logit, range_m, features = field.surfaces(batch)
    weights, _ = weights_from_opacity_logits(torch.where(batch.is_there, logit, -torch.inf))
    total = weights.sum(dim=1)
    share = weights / total.clamp_min(torch.finfo(weights.dtype).eps)[:, None]
    intensity = (share * batch.intensity).sum(dim=1)
    if batch.objects is not None:
        vote = _votes_with_objects(vote, weights.detach(), batch.objects)
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


def _votes_with_objects(vote: Tensor, weights: Tensor, objects: OnObjects) -> Tensor:
    """Votes (r,) where rays that end on an object, by more than half, take its surfaces' mean vote."""
    own = torch.where(objects.mask, weights, 0.0)
    on_object = own.sum(dim=1)
    asked = (own * objects.vote).sum(dim=1) / on_object.clamp_min(torch.finfo(weights.dtype).eps)
    return torch.where(on_object > 0.5 * weights.sum(dim=1), asked, vote)


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
