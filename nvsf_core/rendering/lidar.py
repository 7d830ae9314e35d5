"""How the field answers a LiDAR ray."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from nvsf_core.fields.lidar_field import LidarField
from nvsf_core.fields.surface_batch import SurfaceBatch
from nvsf_core.kernels.composite import composite_rays
from nvsf_core.numerics import probability_logit, require_finite
from nvsf_core.rendering.rendered import RenderedRays

_VOTE_LIMIT = 0.02


@dataclass(frozen=True, slots=True)
class LidarRender:
    """A rendered batch of r rays with k surfaces, differentiable."""

    weights: Tensor
    """(r, k): share of the ray that ends on each surface; rows sum to at most 1."""
    range_m: Tensor
    """(r, k): where the surfaces lie; 0 where there is none."""
    hit_logit: Tensor
    """(r,)."""
    intensity_logit: Tensor
    """(r,)."""


def render_lidar(field: LidarField, batch: SurfaceBatch, hit_prior: Tensor) -> LidarRender:
    """Composite a ray's surfaces, then decode hit and intensity once.

    Args:
        field: The scene.
        batch: Rays and proposed surfaces.
        hit_prior: (r,) share of the nearest training scans that returned here: the prior of the hit. A ray
            that ends on a moving object asks the object's surfaces instead.
    """
    rays = _composite(field, batch, hit_prior)
    both = batch.spread(torch.stack([rays.weights, rays.range_m], dim=1))
    return LidarRender(both[..., 0], both[..., 1], rays.hit_logit, rays.intensity_logit)


class _Rays(NamedTuple):
    """A rendered batch whose m surfaces lie one ray after the other."""

    weights: Tensor
    """(m,)."""
    range_m: Tensor
    """(m,)."""
    median: Tensor
    """(r,): the surface that the ray ends on."""
    total: Tensor
    """(r,): sum of a ray's weights."""
    hit_logit: Tensor
    """(r,)."""
    intensity_logit: Tensor
    """(r,)."""
    hit_prior: Tensor
    """(r,): share of the scans that returned, on a moving object those that saw its place."""


def _composite(field: LidarField, batch: SurfaceBatch, hit_prior: Tensor) -> _Rays:
    logit, range_m, features = field.surfaces(batch)
    weights, summary, median, hit_prior = composite_rays(
        logit, range_m, features, batch.facts, batch.first, batch.hit_prior, hit_prior
    )
    prior_hit = probability_logit(hit_prior, _VOTE_LIMIT)
    prior_intensity = probability_logit(summary[:, -1], 0.01)
    hit, brightness = field.decode(torch.cat([summary, batch.direction, prior_hit[:, None] / 4.0], dim=1))
    total = summary[:, features.shape[1]]
    return _Rays(weights, range_m, median, total, prior_hit + hit, prior_intensity + brightness, hit_prior)


@torch.no_grad()
def render_rays(field: LidarField, batch: SurfaceBatch, hit_prior: Tensor) -> RenderedRays:
    """The weighted median surface, the hit probability and the intensity of each ray.

    Where moving objects have 3 tenths of the weight the median is theirs alone.

    Raises:
        DivergedError: The field's opacities are NaN.
    """
    rays = _composite(field, batch, hit_prior)
    require_finite("render_rays: sum of the weights", rays.total)
    answered = batch.is_there[:, 0]
    range_m = torch.full_like(rays.total, torch.inf)
    range_m[answered] = rays.range_m[rays.median[answered]]
    return RenderedRays(
        range_m=range_m.numpy(),
        hit=torch.where(answered, torch.sigmoid(rays.hit_logit), 0.0).numpy(),
        intensity=torch.sigmoid(rays.intensity_logit).numpy(),
        hit_prior=rays.hit_prior.numpy(),
    )
