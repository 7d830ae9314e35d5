"""Sampling of a training step's pixels: uniform or by the error map, as single pixels or patches."""

from dataclasses import dataclass

import torch
from torch import Tensor

from nvsf_core.errors import ShapeError
from nvsf_core.recipe.paper import PaperSampling
from nvsf_core.sampling.error_map import ErrorMap
from nvsf_core.sampling.patches import patch_pixels, uniform_corners


@dataclass(frozen=True, slots=True, eq=False)
class SampledPixels:
    """The pixels of one step, on the CPU, where recordings lie, wherever the error map learns."""

    rows: Tensor
    """(r,) int64 pixel rows."""
    columns: Tensor
    """(r,) int64 pixel columns."""
    patch: tuple[int, int] | None
    """Rows and columns of a patch: the pixels are patch by patch, row by row, so that `x.view(-1, *patch)`
    has one patch a row. None: single pixels."""


def is_second_epoch(epoch: int) -> bool:
    """Whether an epoch, counted from 0, samples heuristically and in patches.

    Every second one does, from the second on: the first has to fill the error map.
    """
    return epoch % 2 == 1


def uniform_pixels(is_drawable: Tensor, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Rows (count,) and columns (count,) of pixels, uniform over the drawable (H, W) ones, with replacement.

    Raises:
        ShapeError: No pixel may be sampled.
    """
    allowed = is_drawable.flatten().nonzero()[:, 0]
    if len(allowed) == 0:
        shape = tuple(is_drawable.shape)
        raise ShapeError(f"uniform_pixels: expected at least one pixel to draw from, found none in {shape}")
    drawn = torch.randint(len(allowed), (count,), generator=generator, device=generator.device)
    pixel = allowed[drawn.to(allowed.device)]
    return pixel // is_drawable.shape[1], pixel % is_drawable.shape[1]


def sample_lidar_pixels(
    sampling: PaperSampling,
    epoch: int,
    frame: int,
    error_map: ErrorMap,
    generator: torch.Generator,
) -> SampledPixels:
    """The pano pixels of one step.

    `sampling.heuristic` and `sampling.patches` apply in every second epoch (`is_second_epoch`),
    each by itself: patches without the error map are uniform, the error map without patches gives single
    pixels. There are as many patches as fit into `sampling.rays`, at least one.

    Args:
        sampling: Switches and number of rays.
        epoch: From 0.
        frame: Index of the frame in `error_map`.
        error_map: Errors of the panos.
        generator: The only source of randomness.
    """
    height, width = error_map.drawable.shape
    heuristic, patch = sampling.heuristic and is_second_epoch(epoch), sampling.patches
    if patch is None or not is_second_epoch(epoch):
        return sample_pixels(sampling, epoch, frame, error_map, generator)
    count = max(1, sampling.rays // (patch[0] * patch[1]))
    if heuristic:
        corners = error_map.sample_patches(frame, count, patch, generator)
    else:
        corners = uniform_corners((height, width), patch, count, generator)
    rows, columns = patch_pixels(*corners, patch, (height, width))
    return SampledPixels(rows.flatten().cpu(), columns.flatten().cpu(), patch)


def sample_pixels(
    sampling: PaperSampling, epoch: int, frame: int, error_map: ErrorMap, generator: torch.Generator
) -> SampledPixels:
    """Single pixels of one step: by the error map in every second epoch, else uniform.

    Args:
        sampling: Switches and number of rays.
        epoch: From 0.
        frame: Index of the frame in `error_map`.
        error_map: Errors of the images.
        generator: The only source of randomness.
    """
    if sampling.heuristic and is_second_epoch(epoch):
        rows, columns = error_map.sample_pixels(frame, sampling.rays, generator)
    else:
        rows, columns = uniform_pixels(error_map.drawable, sampling.rays, generator)
    return SampledPixels(rows.cpu(), columns.cpu(), None)
