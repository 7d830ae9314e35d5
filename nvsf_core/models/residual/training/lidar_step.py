"""One training step on LiDAR rays."""

import torch
from torch import Tensor

from nvsf_core.evidence.static.surfels import Surfels
from nvsf_core.fields.lidar_field import LidarField
from nvsf_core.fields.surface_batch import SurfaceBatch, surface_batch
from nvsf_core.losses.depth import depth_loss
from nvsf_core.losses.intensity import intensity_loss
from nvsf_core.losses.likelihood import surface_likelihood
from nvsf_core.losses.raydrop import raydrop_loss
from nvsf_core.losses.total import LossBreakdown, total_loss
from nvsf_core.models.residual.training.lidar_rays import LidarRays
from nvsf_core.recipe import ResidualRecipe
from nvsf_core.rendering.lidar import LidarRender, render_lidar
from nvsf_core.rendering.reproject import NEAR_M


def lidar_step(
    field: LidarField,
    surfels: Surfels,
    rays: LidarRays,
    recipe: ResidualRecipe,
    far_m: float,
    generator: torch.Generator,
) -> LossBreakdown:
    """Draw rays from all training frames, render them, and compare with what was recorded.

    The surfels are of what stands; what moves comes with the rays.
    """
    spec = recipe.lidar_training
    drawn = torch.randint(len(rays), (spec.rays,), generator=generator).numpy()
    most = recipe.evidence.lidar_candidates
    batch = surface_batch(
        surfels, rays.origin_m[drawn], rays.direction[drawn], most=most, near_m=NEAR_M, far_m=far_m,
        objects=None if rays.objects is None else rays.objects.of(drawn),
    )  # fmt: skip
    rendered = render_lidar(field, batch, torch.from_numpy(rays.hit_prior[drawn]))
    true_range_m = torch.from_numpy(rays.range_m[drawn])
    returned = (true_range_m > 0) & batch.is_there[:, 0]
    seen = batch.is_there[:, 0]
    terms = {
        "depth": _depth(rendered, batch, returned, true_range_m),
        "hit": raydrop_loss(rendered.hit_logit[seen], (true_range_m[seen] > 0).float()),
        "intensity": intensity_loss(
            rendered.intensity_logit[returned], torch.from_numpy(rays.intensity[drawn])[returned]
        ),
    }
    weights = recipe.losses
    return total_loss(terms, {"depth": weights.depth, "hit": weights.hit, "intensity": weights.intensity})


def _depth(rendered: LidarRender, batch: SurfaceBatch, returned: Tensor, true_range_m: Tensor) -> Tensor:
    """Of each ray that `returned` (r,) bool: how far its surfaces are off, or on what moves how unlikely.

    A moving object is thin, seen by few rays and mostly edge: there weights must stay shares of the rays.
    """
    of_returns = rendered.weights[returned], rendered.range_m[returned], true_range_m[returned]
    off_m = depth_loss(*of_returns)
    if not bool((batch.hit_prior >= 0.0).any()):
        return off_m
    meets = batch.spread((batch.hit_prior >= 0.0).float()[:, None])[returned, :, 0].any(dim=1)
    return torch.where(meets, surface_likelihood(*of_returns), off_m)
