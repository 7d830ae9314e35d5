"""Training steps of the camera networks: each training image is rendered from the others."""

import math
from collections.abc import Sequence
from dataclasses import asdict

import torch
from torch import Tensor

from nvsf_core.fields.camera_networks import CameraNetworks, DepthNetwork
from nvsf_core.losses.total import LossBreakdown, total_loss
from nvsf_core.models.residual.camera_examples import LeftOut
from nvsf_core.recipe import ResidualRecipe
from nvsf_core.rendering.camera_view import Window
from nvsf_core.rendering.learned_warp import blend_sources
from nvsf_core.rendering.plane_depth import planes_of

_MARGIN = 6
"""Shrunk pixels at a window's border that are not compared: the networks lack their surroundings."""


def depth_step(
    network: DepthNetwork, examples: Sequence[LeftOut], recipe: ResidualRecipe, generator: torch.Generator
) -> LossBreakdown:
    """The loss of an image's depth planes by the other images, weighted by their probability, in a window."""
    example = _sampled(examples, generator)
    shape = (example.view.small.height, example.view.small.width)
    window = sample_window(shape, recipe.depth_training.rays // recipe.depth_training.parts, generator)
    probability, colour = planes_of(network, example.view, recipe.camera, window)
    truth = example.small_truth[:, *window]
    shown = _shown(example.view.images.small, window)
    terms = {
        "coarse": ((probability[:, None] * colour).sum(dim=0) - truth).square().mean(dim=0)[shown],
        "plane": _believed_error(probability, colour, truth)[shown],
    }
    return total_loss(terms, asdict(recipe.losses))


def camera_step(
    networks: CameraNetworks, examples: Sequence[LeftOut], recipe: ResidualRecipe, generator: torch.Generator
) -> LossBreakdown:
    """The loss of a window of a left-out image, rendered from the other images and their depths."""
    example = _sampled(examples, generator)
    view = example.view
    assert example.coarse is not None
    shape = (view.small.height, view.small.width)
    around = sample_window(shape, recipe.camera_training.rays // recipe.camera_training.parts, generator)
    window = _full_size(around, shape, view.factor)
    shown = blend_sources(networks, view, example.coarse, window)
    difference = shown - example.truth[:, *window].float() / 255.0
    is_valid = _shown(view.images.full, window)
    terms = {
        "colour": difference.square().mean(dim=0)[is_valid],
        "colour_distance": difference.abs().mean(dim=0)[is_valid],
    }
    return total_loss(terms, asdict(recipe.losses))


def _believed_error(probability: Tensor, colour: Tensor, truth: Tensor) -> Tensor:
    """Absolute error (h, w) of the colours (d, 3, h, w) of d depths, weighted by probabilities (d, h, w)."""
    return (probability * (colour - truth).abs().mean(dim=1)).sum(dim=0)


def _full_size(window: Window, shape: tuple[int, int], factor: int) -> Window:
    """The window in full-size pixels, without a margin where the networks lack the surroundings."""
    sides = []
    for side, length in zip(window, shape, strict=True):
        margin = min(_MARGIN, (side.stop - side.start) // 4)
        first = side.start + (margin if side.start > 0 else 0)
        last = side.stop - (margin if side.stop < length else 0)
        sides.append(slice(first * factor, last * factor))
    return sides[0], sides[1]


def sample_window(shape: tuple[int, int], pixels: int, generator: torch.Generator) -> Window:
    """A random window of about `pixels` pixels, 1.5 times as wide as high, in an image of (rows, columns)."""
    height = min(shape[0], max(1, round(math.sqrt(pixels / 1.5))))
    width = min(shape[1], max(1, pixels // height))
    row = int(torch.randint(shape[0] - height + 1, (), generator=generator))
    column = int(torch.randint(shape[1] - width + 1, (), generator=generator))
    return slice(row, row + height), slice(column, column + width)


def _sampled(examples: Sequence[LeftOut], generator: torch.Generator) -> LeftOut:
    return examples[int(torch.randint(len(examples), (), generator=generator))]


def _shown(images: Tensor, window: Window) -> Tensor:
    """(h, w) bool: valid pixels of the window; they are the same in all images of a camera."""
    return images[0, 3][window] > 0.999
