"""One training step on pixels."""

import torch

from nvsf_core.evidence.surfels import Surfels
from nvsf_core.fields.camera_field import CameraField
from nvsf_core.fields.surface_batch import surface_batch
from nvsf_core.losses.colour import colour_loss
from nvsf_core.losses.total import LossBreakdown, total_loss
from nvsf_core.recipe import Recipe
from nvsf_core.rendering.camera import NEAR_M, render_colour
from nvsf_core.training.pixels import CameraImages, draw_pixels


def camera_step(
    field: CameraField,
    surfels: Surfels,
    cameras: list[CameraImages],
    recipe: Recipe,
    generator: torch.Generator,
) -> LossBreakdown:
    """Draw pixels from all training images, render them, and compare with what was recorded."""
    origin, direction, colour = draw_pixels(cameras, recipe.camera_training.rays, generator)
    most = recipe.evidence.camera_candidates
    batch = surface_batch(surfels, origin, direction, most=most, near_m=NEAR_M, far_m=recipe.background.far_m)
    shown = render_colour(field, batch, recipe.background)
    return total_loss(
        {"colour": colour_loss(shown, torch.from_numpy(colour))}, {"colour": recipe.losses.colour}
    )
