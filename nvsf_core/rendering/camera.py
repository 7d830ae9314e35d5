"""What a camera ray shows."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from nvsf_core.evidence.surfels import Surfels
from nvsf_core.fields.camera_field import CameraField
from nvsf_core.fields.surface_batch import N_FACTS, SurfaceBatch, surface_batch
from nvsf_core.recipe import BackgroundSpec
from nvsf_core.rendering.weights import weights_from_opacity_logits

NEAR_M = 0.3
"""Nothing that an image shows is nearer to its camera."""
_CONFIDENT = 0.5

Propose = Callable[[np.ndarray, np.ndarray], SurfaceBatch]
"""Scene-local origins (r, 3) and unit directions (r, 3) to rays with the surfaces proposed for them."""


def proven_surfaces(surfels: Surfels, *, most: int, far_m: float) -> Propose:
    """Propose what the LiDAR proved, `most` surfaces a ray, up to `far_m`."""

    def propose(origin_m: np.ndarray, direction: np.ndarray) -> SurfaceBatch:
        return surface_batch(surfels, origin_m, direction, most=most, near_m=NEAR_M, far_m=far_m)

    return propose


def no_surfaces(origin_m: np.ndarray, direction: np.ndarray) -> SurfaceBatch:
    """Propose nothing, for a drive without LiDAR: the background's samples are all that a ray has."""
    places = (len(origin_m), 1)
    return SurfaceBatch(
        origin_m=torch.from_numpy(np.ascontiguousarray(origin_m, np.float32)),
        direction=torch.from_numpy(np.ascontiguousarray(direction, np.float32)),
        range_m=torch.zeros(places),
        logit=torch.zeros(places),
        is_there=torch.zeros(places, dtype=torch.bool),
        facts=torch.zeros(*places, N_FACTS),
    )


def render_colour(field: CameraField, batch: SurfaceBatch, spec: BackgroundSpec) -> Tensor:
    """Colour (r, 3) in 0..1: surfaces first, then the background behind the last sure one, then sky."""
    logit, features = field.surfaces(batch)
    surfaces = torch.where(batch.is_there, logit, -torch.inf)
    behind_m = _background_ranges(batch, spec)
    air, air_features = field.beyond(batch, behind_m)
    # Background samples may lie before an unsure surface: the light meets them in the order of range.
    ranges = torch.cat([torch.where(batch.is_there, batch.range_m, torch.inf), behind_m], dim=1)
    order = torch.argsort(ranges, dim=1)
    logits = torch.cat([surfaces, air], dim=1).gather(1, order)
    weights, left = weights_from_opacity_logits(logits)
    # Weights go back to where their features are: gathering (r, k, d) features would copy them all.
    unsorted = torch.zeros_like(weights).scatter(1, order, weights)
    k = surfaces.shape[1]
    composited = (unsorted[:, :k, None] * features).sum(dim=1) + (unsorted[:, k:, None] * air_features).sum(
        dim=1
    )
    return field.colour(composited, left, batch.direction)


def _background_ranges(batch: SurfaceBatch, spec: BackgroundSpec) -> Tensor:
    """(r, b) ranges, evenly spaced in log from behind the first sure surface (else `near_m`) to `far_m`."""
    sure = batch.is_there & (batch.logit > torch.logit(torch.tensor(_CONFIDENT)))
    first = torch.where(sure, batch.range_m, torch.inf).amin(dim=1)
    start = torch.where(torch.isfinite(first), first + 1.0, spec.near_m).clamp(spec.near_m, 0.9 * spec.far_m)
    share = (torch.arange(spec.samples) + 0.5) / spec.samples
    return start[:, None] * (spec.far_m / start)[:, None] ** share
