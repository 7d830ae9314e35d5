"""Training steps of the camera's networks: each training image is shown by the others."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import torch
from torch import Tensor

from nvsf_core.fields.camera_networks import CameraNetworks, DepthNetwork
from nvsf_core.losses.total import LossBreakdown, total_loss
from nvsf_core.recipe import ResidualRecipe
from nvsf_core.rendering.learned_warp import CameraView, Window, blend_sources, planes_of
from nvsf_core.rendering.plane_volume import Sources, depth_belief, plane_inverses

_MARGIN = 6
"""Shrunk pixels at a window's rim whose depth is not looked through: their surroundings are cut off."""


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A training image and what the others know of it."""

    view: CameraView
    """Without the image itself, and without the scan of its instant."""
    truth: Tensor
    """(3, H, W) uint8."""
    small_truth: Tensor
    """(3, h, w) float32 in 0..1, shrunk."""
    small_sources: Sources
    """The view's, shrunk."""


def depth_step(
    network: DepthNetwork, examples: Sequence[LeftOut], recipe: ResidualRecipe, generator: torch.Generator
) -> LossBreakdown:
    """Compare a window's planes, weighted by what is believed of them, with a left-out image."""
    example = _drawn(examples, generator)
    shape = (example.view.small.height, example.view.small.width)
    window = draw_window(shape, recipe.depth_training.rays, generator)
    probability, colour = planes_of(network, example.view, example.small_sources, recipe.camera, window)
    return total_loss(_plane_terms(example, window, probability, colour), asdict(recipe.losses))


def camera_step(
    networks: CameraNetworks, examples: Sequence[LeftOut], recipe: ResidualRecipe, generator: torch.Generator
) -> LossBreakdown:
    """Show a window of a left-out image by both networks, and compare; the planes go on being compared."""
    example = _drawn(examples, generator)
    view = example.view
    shape = (view.small.height, view.small.width)
    around = draw_window(shape, recipe.camera_training.rays, generator)
    probability, colour = planes_of(networks.depth, view, example.small_sources, recipe.camera, around)
    belief = depth_belief(probability, colour, plane_inverses(recipe.camera))
    window = _full_size(around, shape, view.factor)
    shown = blend_sources(networks.blend, view, belief.placed(around, shape), window)
    difference = shown - example.truth[:, *window].float() / 255.0
    answered = _shown(example, window, shrunk=False)
    terms = _plane_terms(example, around, probability, colour) | {
        "colour": difference.square().mean(dim=0)[answered],
        "colour_distance": difference.abs().mean(dim=0)[answered],
    }
    return total_loss(terms, asdict(recipe.losses))


def _plane_terms(example: LeftOut, window: Window, probability: Tensor, colour: Tensor) -> dict[str, Tensor]:
    """What planes show against the left-out image: their mean, and each as far as it is believed."""
    truth = example.small_truth[:, *window]
    mean = (probability[:, None] * colour).sum(dim=0)
    plane_error = (colour - truth).abs().mean(dim=1)
    shown = _shown(example, window, shrunk=True)
    return {
        "coarse": (mean - truth).square().mean(dim=0)[shown],
        "plane": (probability * plane_error).sum(dim=0)[shown],
    }


def _full_size(window: Window, shape: tuple[int, int], factor: int) -> Window:
    """The window's pixels in the image, but for a margin where the networks lack a surrounding."""
    sides = []
    for side, length in zip(window, shape, strict=True):
        margin = min(_MARGIN, (side.stop - side.start) // 4)
        first = side.start + (margin if side.start > 0 else 0)
        last = side.stop - (margin if side.stop < length else 0)
        sides.append(slice(first * factor, last * factor))
    return sides[0], sides[1]


def draw_window(shape: tuple[int, int], pixels: int, generator: torch.Generator) -> Window:
    """A window of about so many pixels, half as wide again as high, anywhere in an image (rows, columns)."""
    height = min(shape[0], max(1, round(math.sqrt(pixels / 1.5))))
    width = min(shape[1], max(1, pixels // height))
    row = int(torch.randint(shape[0] - height + 1, (), generator=generator))
    column = int(torch.randint(shape[1] - width + 1, (), generator=generator))
    return slice(row, row + height), slice(column, column + width)


def _drawn(examples: Sequence[LeftOut], generator: torch.Generator) -> LeftOut:
    return examples[int(torch.randint(len(examples), (), generator=generator))]


def _shown(example: LeftOut, window: Window, *, shrunk: bool) -> Tensor:
    """(h, w) bool: pixels of the window at which the left-out image shows anything."""
    # All images of a camera show the same pixels.
    image = example.small_sources.image[0] if shrunk else example.view.images[0]
    return image[3][window] > 0.999
