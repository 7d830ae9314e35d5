"""Recorded images around a view, and what they show of a pixel at a depth, moving things included."""

from dataclasses import dataclass

import torch
from torch import Tensor

from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.rendering.warping import sample, source_pixels

STATIC = 0
"""Label of pixels that show what does not move."""


@dataclass(frozen=True, slots=True)
class Sources:
    """Recorded images around a view, the nearest first."""

    image: tuple[Tensor, ...]
    """k of (c, H, W) float32: colour in 0..1, 1 where the pixel shows anything, and, where something
    moves in the drive, 1 where the pixel shows that."""
    motion: Tensor
    """(k, 4, 4) float32 from the view's frame to the source's."""
    nearness: Tensor
    """(k,) float32, 1 for the nearest; inversely proportional to the distance. 0: a place holder."""
    moved: Tensor | None = None
    """(o, k, 4, 4) the same for each moving object, its own motion included, label 1 first; 0 where its
    place is not known when the source was taken. None = nothing moves."""


def look_up(
    sources: Sources, number: int, rays: Tensor, inverse: Tensor, pinhole: Pinhole, label: Tensor | None
) -> tuple[Tensor, Tensor]:
    """What a source shows of a view's pixels: colour (3, d, h, w), and whether it shows them (d, h, w).

    A still pixel is not shown where something that moves stood before it when the source was taken.

    Args:
        sources: Of the view.
        number: Which of them.
        rays: (h, w, 3) of the pixels.
        inverse: (d, h, w) or (d, 1, 1) inverse depths, 1/m.
        pinhole: Of the sources.
        label: (h, w) integers, 1 and more for the moving object that a pixel shows; None = nothing moves.
    """
    image = sources.image[number]
    grid, inside = source_pixels(sources.motion[number], rays, inverse, pinhole)
    if label is not None and sources.moved is not None:
        for thing in torch.unique(label[label > STATIC]).tolist():
            where = label == thing
            depths = inverse.expand(len(inverse), *label.shape)[:, where]
            moved = sources.moved[thing - 1, number]
            grid[:, where], inside[:, where] = source_pixels(moved, rays[where], depths, pinhole)
    found = sample(image, grid.flatten(0, 1)).reshape(-1, *inside.shape)
    seen = inside & (found[3] > 0.999) & (sources.nearness[number] > 0)
    if label is not None and len(found) > 4:
        seen = seen & ((found[4] < 0.5) | (label > STATIC))
    return found[:3], seen
