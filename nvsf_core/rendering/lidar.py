"""Rendering of LiDAR rays by a trained field: range, hit probability and intensity."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from nvsf_core.fields.lidar_field import LidarField, SurfaceBatch
from nvsf_core.kernels.composite import composite_rays
from nvsf_core.numerics import probability_logit, require_finite
from nvsf_core.rendering.rendered import RenderedRays

_PRIOR_LIMIT = 0.02
"""The prior of a hit is kept this far away from 0 and 1, so that the field can correct it."""


@dataclass(frozen=True, slots=True)
class LidarRender:
    """A rendered batch of r rays with up to k surfaces each; differentiable."""

    weights: Tensor
    """(r, k) share of the ray that ends on each surface; rows sum to at most 1."""
    range_m: Tensor
    """(r, k) range of each surface, metres; 0 where there is none."""
    hit_logit: Tensor
    """(r,) logit of the hit probability."""
    intensity_logit: Tensor
    """(r,) logit of the intensity."""
    on_object: Tensor
    """(r,) bool: the ray ends on a moving object, whose hit prior is not corrected."""


def render_lidar(field: LidarField, batch: SurfaceBatch, hit_prior: Tensor) -> LidarRender:
    """Composite each ray's surfaces, then decode its hit probability and intensity once.

    Args:
        field: Trained or in training.
        batch: Rays and their candidate surfaces.
        hit_prior: (r,) share of the nearest training scans that returned here. A ray that ends on a moving
            object uses the object's own hit prior instead.
    """
    rays = _composite(field, batch, hit_prior)
    both = batch.spread(torch.stack([rays.weights, rays.range_m], dim=1))
    return LidarRender(both[..., 0], both[..., 1], rays.hit_logit, rays.intensity_logit, rays.on_object)


class _Rays(NamedTuple):
    """A rendered batch of r rays whose m surfaces are stored flat, ray after ray."""

    weights: Tensor
    """(m,) share of the ray that ends on each surface."""
    range_m: Tensor
    """(m,) metres."""
    median: Tensor
    """(r,) index of the surface at which half of the ray's weight is reached."""
    total: Tensor
    """(r,) sum of a ray's weights."""
    hit_logit: Tensor
    """(r,) logit of the hit probability."""
    intensity_logit: Tensor
    """(r,) logit of the intensity."""
    hit_prior: Tensor
    """(r,) see `RenderedRays`."""
    on_object: Tensor
    """(r,) bool, see `RenderedRays`."""


def _composite(field: LidarField, batch: SurfaceBatch, hit_prior: Tensor) -> _Rays:
    logit, range_m, features = field.surfaces(batch)
    weights, summary, median, hit_prior, on_object = composite_rays(
        logit, range_m, features, batch.facts, batch.first, batch.hit_prior, hit_prior
    )
    prior_hit = probability_logit(hit_prior, _PRIOR_LIMIT)
    prior_intensity = probability_logit(summary[:, -1], 0.01)
    hit, brightness = field.decode(torch.cat([summary, batch.direction, prior_hit[:, None] / 4.0], dim=1))
    total = summary[:, features.shape[1]]
    logits = prior_hit + hit, prior_intensity + brightness
    return _Rays(weights, range_m, median, total, *logits, hit_prior, on_object)


@torch.no_grad()
def render_rays(field: LidarField, batch: SurfaceBatch, hit_prior: Tensor) -> RenderedRays:
    """Range (of the weighted median surface), hit probability and intensity of each ray; no gradients.

    Where moving objects have 3 tenths of the weight, only their surfaces count for the median. There the hit
    probability is the hit prior: few rays meet an object, and hits that were learned from them were no better
    on left-out scans (docs/lean.md).

    Args:
        field: Trained.
        batch: r rays and their candidate surfaces.
        hit_prior: (r,) as of `render_lidar`.

    Raises:
        DivergedError: The field's opacities are NaN.
    """
    rays = _composite(field, batch, hit_prior)
    require_finite("render_rays: sum of the weights", rays.total)
    has_surface = batch.is_there[:, 0]
    range_m = torch.full_like(rays.total, torch.inf)
    range_m[has_surface] = rays.range_m[rays.median[has_surface]]
    hit = torch.where(rays.on_object, rays.hit_prior, torch.sigmoid(rays.hit_logit))
    return RenderedRays(
        range_m=range_m.numpy(),
        hit=torch.where(has_surface, hit, 0.0).numpy(),
        intensity=torch.sigmoid(rays.intensity_logit).numpy(),
        hit_prior=rays.hit_prior.numpy(),
        on_object=rays.on_object.numpy(),
    )
