"""Colours of the source images at several depths of each pixel of a view, and how well they agree."""

from dataclasses import dataclass

import torch
from torch import Tensor

from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.rendering.sources import Sources, look_up

_UNSEEN_DIFFERENCE = 0.25
"""Colour difference that is assumed where fewer than two sources show a plane."""
_NEAREST = 2
"""This many nearest sources have weight 1 in a plane's colour."""
_FARTHER_WEIGHT = 0.3
"""Weight of the other sources in a plane's colour."""


@dataclass(frozen=True, slots=True)
class PlaneVolume:
    """Colours of k sources on d depth planes of a view."""

    colour: Tensor
    """(k, 3, d, h, w) in 0..1."""
    seen: Tensor
    """(k, d, h, w) bool: the source shows the pixel at this depth."""

    def agreement(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """How well the sources agree on each plane.

        Returns:
            Mean difference of all sources to their mean (d, h, w), 0..1; difference of the two nearest ones
            (d, h, w), 0..1; share of sources that show the plane (d, h, w); mean colour (d, 3, h, w).
        """
        shown = self.seen[:, None].float()
        count = shown.sum(dim=0)
        mean = (self.colour * shown).sum(dim=0) / count.clamp_min(1e-6)
        spread = ((self.colour - mean).abs().mean(dim=1) * shown[:, 0]).sum(dim=0)
        count = count[0]
        spread = torch.where(count > 1.5, spread / count.clamp_min(1e-6), _UNSEEN_DIFFERENCE)
        pair = spread
        if len(shown) > 1:
            difference = (self.colour[0] - self.colour[1]).abs().mean(dim=0)
            pair = torch.where(self.seen[0] & self.seen[1], difference, _UNSEEN_DIFFERENCE)
        return spread, pair, count / len(shown), mean.transpose(0, 1)

    def without_first(self) -> "PlaneVolume":
        """The volume of all sources but the first."""
        return PlaneVolume(self.colour[1:], self.seen[1:])

    def mean_colour(self) -> Tensor:
        """Mean colour (d, 3, h, w), mostly of the two nearest sources; 0 where none shows the plane."""
        weight = torch.full((len(self.seen), 1, 1, 1, 1), _FARTHER_WEIGHT, device=self.seen.device)
        weight[:_NEAREST] = 1.0
        weight = weight * self.seen[:, None]
        mean = (weight * self.colour).sum(dim=0) / weight.sum(dim=0).clamp_min(1e-6)
        return mean.transpose(0, 1)


def plane_volume(
    sources: Sources, rays: Tensor, pinhole: Pinhole, inverses: Tensor, label: Tensor | None = None
) -> PlaneVolume:
    """Look up every plane in every source.

    Args:
        sources: Source images of the view.
        rays: (h, w, 3) directions (x, y, 1) of the view's pixels, all or a window.
        pinhole: Intrinsics of the source images.
        inverses: (d, 1, 1) inverse depths of planes, or (d, h, w) of each pixel, 1/m.
        label: (h, w) number of the moving object that a pixel shows, 0 = static; None = nothing moves.
    """
    found = [look_up(sources, k, rays, inverses, pinhole, label) for k in range(len(sources.image))]
    return PlaneVolume(torch.stack([colour for colour, _ in found]), torch.stack([seen for _, seen in found]))
