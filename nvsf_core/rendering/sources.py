"""Source images of a view, and their colours at its pixels for given depths, moving objects included."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.kernels.images import interpolation
from nvsf_core.kernels.images.source_lookup import LookUp, look_up_points
from nvsf_core.numerics import require_finite
from nvsf_core.rendering.warping import sample, source_pixels

SHOWN, DEPTH, MOVING = int(interpolation.SHOWN), int(interpolation.DEPTH), int(interpolation.MOVING)
"""Channels of `Sources.images` after the colours."""
STATIC = 0
"""Label of pixels that show static surfaces."""
_HIDDEN_SHARE, _HIDDEN_PER_M = 0.1, 0.004
"""A point is hidden in an image whose own surface there is nearer: its inverse depth is larger by more than
this share of the point's plus so much, 1/m."""


@dataclass(frozen=True, slots=True)
class Sources:
    """Recorded images around a view, the nearest first."""

    images: Tensor
    """(j, c, H, W) float32, all images of the camera. Channels: colour in 0..1; 1 where the pixel shows
    anything; inverse depth of the surface that it shows, 1/m, 0 = unknown; and, in drives with moving
    objects, 1 where the pixel shows one."""
    chosen: list[int]
    """Which k of them are the sources."""
    motion: Tensor
    """(k, 4, 4) float32 from the view's camera frame to the source's."""
    nearness: Tensor
    """(k,) float32, inversely proportional to the distance, 1 for the nearest; 0 = placeholder."""
    moved: Tensor | None = None
    """(o, k, 4, 4) `motion` combined with the own motion of each moving object, label 1 first; zeros where
    its pose at the source's instant is unknown. None = nothing moves."""


@dataclass(frozen=True, slots=True)
class Neighbours:
    """Which recorded images are looked up for a view, and where they stand to it; fields as of `Sources`."""

    chosen: list[int]
    """(k,)."""
    motion: Tensor
    """(k, 4, 4)."""
    nearness: Tensor
    """(k,)."""
    moved: Tensor | None = None
    """(o, k, 4, 4)."""

    def of(self, images: Tensor) -> Sources:
        """As sources, of all images (j, c, h, w) of any size."""
        return Sources(images, self.chosen, self.motion, self.nearness, self.moved)

    def to(self, device: torch.device) -> "Neighbours":
        """The same with tensors on `device`."""
        moved = None if self.moved is None else self.moved.to(device)
        return Neighbours(self.chosen, self.motion.to(device), self.nearness.to(device), moved)


@dataclass(frozen=True, slots=True)
class SeenPoints:
    """Points of a view's pixels: d depths of each, all pixels or those of a window."""

    rays: Tensor
    """(h, w, 3) float32 directions (x, y, 1) of the pixels."""
    inverse: Tensor
    """(d, h, w), or (d, 1, 1) the same for all pixels, inverse depths, 1/m."""
    label: Tensor | None = None
    """(h, w) uint8 number of the moving object that a pixel shows, 0 = static; None = nothing moves."""


def hides(own: Tensor, inverse: Tensor) -> Tensor:
    """Whether a surface of inverse depth `own` hides a point of inverse depth `inverse`, 1/m; bool."""
    return own > inverse * (1.0 + _HIDDEN_SHARE) + _HIDDEN_PER_M


def look_up(sources: Sources, points: SeenPoints, pinhole: Pinhole) -> tuple[Tensor, Tensor]:
    """Colours (k, 3, d, h, w) of the sources at points, and whether they show them (k, d, h, w) bool.

    A pixel is not shown where the source's own depth map has a surface in front of it, nor is a static one
    where a moving object hid it when the source image was taken. What is not shown is 0. Colours are
    bicubic: bilinear ones are blurred between pixels.

    Raises:
        DivergedError: An inverse depth is not finite.
    """
    require_finite("inverse depths", points.inverse)
    colour, seen = look_up_points(kernel_inputs(sources, points, pinhole))
    return torch.from_numpy(colour), torch.from_numpy(seen)


def look_up_by_torch(sources: Sources, points: SeenPoints, pinhole: Pinhole) -> tuple[Tensor, Tensor]:
    """The same on any device, but with bilinear colours."""
    each = [_look_up_one(sources, k, points, pinhole) for k in range(len(sources.chosen))]
    return torch.stack([colour for colour, _ in each]), torch.stack([seen for _, seen in each])


def kernel_inputs(sources: Sources, points: SeenPoints, pinhole: Pinhole) -> LookUp:
    """Sources and points, on the CPU, as the kernels take them."""
    motions, label = _pixel_motions(sources, points, pinhole)
    return LookUp(
        np.ascontiguousarray(sources.images.permute(0, 2, 3, 1).numpy()), np.array(sources.chosen, np.int64),
        motions, np.ascontiguousarray(points.rays.numpy()), label,
        np.ascontiguousarray(points.inverse.numpy()),
        (np.float32(_HIDDEN_SHARE), np.float32(_HIDDEN_PER_M)),
    )  # fmt: skip


def _pixel_motions(sources: Sources, points: SeenPoints, pinhole: Pinhole) -> tuple[np.ndarray, np.ndarray]:
    """Motions (m, k, 3, 4) float32 to the sources' pixels, and which of them each pixel has, (h, w) uint8.

    They are those of `LookUp`.
    """
    motions = sources.motion[None]
    if points.label is not None and sources.moved is not None:
        motions = torch.cat([motions, sources.moved])
    matrix = torch.tensor([[pinhole.fx, 0.0, pinhole.cx], [0.0, pinhole.fy, pinhole.cy], [0.0, 0.0, 1.0]])
    # A placeholder shows nothing: with zeros every point is behind it.
    motions = (matrix @ motions[..., :3, :]) * (sources.nearness > 0.0)[:, None, None]
    if len(motions) == 1 or points.label is None:
        return motions.numpy(), np.zeros(points.rays.shape[:2], np.uint8)
    return motions.numpy(), np.ascontiguousarray(points.label.numpy())


def _look_up_one(
    sources: Sources, number: int, points: SeenPoints, pinhole: Pinhole
) -> tuple[Tensor, Tensor]:
    """Colour (3, d, h, w) of a source, and whether it shows the points (d, h, w) bool."""
    image, label, inverse = sources.images[sources.chosen[number]], points.label, points.inverse
    grid, inside, there = source_pixels(sources.motion[number], points.rays, inverse, pinhole)
    if label is not None and sources.moved is not None:
        for mover in torch.unique(label[label > STATIC]).tolist():
            where = label == mover
            depths = inverse.expand(len(inverse), *label.shape)[:, where]
            moved = sources.moved[mover - 1, number]
            grid[:, where], inside[:, where], there[:, where] = source_pixels(
                moved, points.rays[where], depths, pinhole
            )
    places = grid.flatten(0, 1)
    found = sample(image, places).reshape(-1, *inside.shape)
    seen = inside & (found[SHOWN] > 0.999) & (sources.nearness[number] > 0)
    is_hidden = hides(found[DEPTH], there)
    if label is not None and len(found) > MOVING:
        is_hidden = is_hidden | ((found[MOVING] > 0.5) & (label == STATIC))
    return found[:SHOWN], seen & ~is_hidden
