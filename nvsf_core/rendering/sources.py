"""Source images of a view, and their colours at its pixels for given depths, moving objects included."""

from dataclasses import dataclass

import torch
from torch import Tensor

from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.rendering.warping import sample, source_pixels

STATIC = 0
"""Label of pixels that show static surfaces."""
_HIDDEN_SHARE, _HIDDEN_PER_M = 0.1, 0.004
"""A point is hidden in an image whose own surface there is nearer: its inverse depth is larger by more than
this share of the point's plus so much, 1/m."""


@dataclass(frozen=True, slots=True)
class Sources:
    """Recorded images around a view, the nearest first."""

    image: tuple[Tensor, ...]
    """k images (c, H, W) float32. Channels: colour in 0..1; 1 where the pixel shows anything; inverse depth
    of the static surface that it shows, 1/m, 0 = unknown; and, in drives with moving objects, 1 where the
    pixel shows one."""
    motion: Tensor
    """(k, 4, 4) float32 from the view's camera frame to the source's."""
    nearness: Tensor
    """(k,) float32, inversely proportional to the distance, 1 for the nearest; 0 = placeholder."""
    moved: Tensor | None = None
    """(o, k, 4, 4) `motion` combined with the own motion of each moving object, label 1 first; zeros where
    its pose at the source's instant is unknown. None = nothing moves."""


def hides(own: Tensor, inverse: Tensor) -> Tensor:
    """Whether a surface of inverse depth `own` hides a point of inverse depth `inverse`, 1/m; bool."""
    return own > inverse * (1.0 + _HIDDEN_SHARE) + _HIDDEN_PER_M


def look_up(
    sources: Sources, number: int, rays: Tensor, inverse: Tensor, pinhole: Pinhole, label: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Colour (3, d, h, w) of a source at a view's pixels, and whether it shows them (d, h, w) bool.

    A static pixel is not shown where the source's own depth map has a surface in front of it, or where a
    moving object hid it when the source image was taken.

    Args:
        sources: Source images of the view.
        number: Index of the source.
        rays: (h, w, 3) directions (x, y, 1) of the pixels.
        inverse: (d, h, w) or (d, 1, 1) inverse depths, 1/m.
        pinhole: Intrinsics of the sources.
        label: (h, w) number of the moving object that a pixel shows, 0 = static; None = nothing moves.
    """
    image = sources.image[number]
    grid, inside, there = source_pixels(sources.motion[number], rays, inverse, pinhole)
    if label is not None and sources.moved is not None:
        for mover in torch.unique(label[label > STATIC]).tolist():
            where = label == mover
            depths = inverse.expand(len(inverse), *label.shape)[:, where]
            moved = sources.moved[mover - 1, number]
            grid[:, where], inside[:, where], there[:, where] = source_pixels(
                moved, rays[where], depths, pinhole
            )
    found = sample(image, grid.flatten(0, 1)).reshape(-1, *inside.shape)
    seen = inside & (found[3] > 0.999) & (sources.nearness[number] > 0)
    is_hidden = hides(found[4], there)
    if label is not None and len(found) > 5:
        is_hidden = (is_hidden | (found[5] > 0.5)) & (label == STATIC)
    return found[:3], seen & ~is_hidden
