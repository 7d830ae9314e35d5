"""One training step on pixels."""

import torch

from nvsf_core.fields.camera_field import CameraField
from nvsf_core.losses.colour import colour_loss
from nvsf_core.losses.total import LossBreakdown, total_loss
from nvsf_core.recipe import ResidualRecipe
from nvsf_core.rendering.camera import Propose, render_colour
from nvsf_core.training.pixels import CameraImages, draw_pixels


def camera_step(
    field: CameraField,
    propose: Propose,
    cameras: list[CameraImages],
    recipe: ResidualRecipe,
    generator: torch.Generator,
) -> LossBreakdown:
    """Draw pixels from all training images, render them, and compare with what was recorded."""
    origin, direction, colour = draw_pixels(cameras, recipe.camera_training.rays, generator)
    shown = render_colour(field, propose(origin, direction), recipe.background)
    return total_loss(
        {"colour": colour_loss(shown, torch.from_numpy(colour))}, {"colour": recipe.losses.colour}
    )
