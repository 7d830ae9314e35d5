"""Training steps of the depth network: each training image is compared with those around it."""

import math
from collections.abc import Sequence
from dataclasses import asdict

import torch

from nvsf_core.fields.depth_network import DepthNetwork
from nvsf_core.losses.total import LossBreakdown, total_loss
from nvsf_core.models.residual.camera_examples import RecordedView
from nvsf_core.recipe.residual import ResidualRecipe
from nvsf_core.rendering.camera_view import Window
from nvsf_core.rendering.plane_depth import planes_of
from nvsf_core.rendering.sources import SHOWN


def depth_step(
    network: DepthNetwork,
    examples: Sequence[RecordedView],
    recipe: ResidualRecipe,
    generator: torch.Generator,
) -> LossBreakdown:
    """The loss of an image's depth planes by the other images, weighted by their probability, in a window."""
    example = examples[int(torch.randint(len(examples), (), generator=generator))]
    shape = (example.view.small.height, example.view.small.width)
    window = sample_window(shape, recipe.depth_training.rays // recipe.depth_training.parts, generator)
    probability, colour = planes_of(network, example.view, recipe.camera, window)
    truth = example.truth[:, *window]
    # Valid pixels are the same in all images of a camera.
    shown = example.view.images.small[0, SHOWN][window] > 0.999
    terms = {
        "coarse": ((probability[:, None] * colour).sum(dim=0) - truth).square().mean(dim=0)[shown],
        "plane": (probability * (colour - truth).abs().mean(dim=1)).sum(dim=0)[shown],
    }
    return total_loss(terms, asdict(recipe.losses))


def sample_window(shape: tuple[int, int], pixels: int, generator: torch.Generator) -> Window:
    """A random window of about `pixels` pixels, 1.5 times as wide as high, in an image of (rows, columns)."""
    height = min(shape[0], max(1, round(math.sqrt(pixels / 1.5))))
    width = min(shape[1], max(1, pixels // height))
    row = int(torch.randint(shape[0] - height + 1, (), generator=generator))
    column = int(torch.randint(shape[1] - width + 1, (), generator=generator))
    return slice(row, row + height), slice(column, column + width)
