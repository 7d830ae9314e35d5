"""Colours of the source images at several depths of each pixel of a view, and how well they agree."""

from typing import NamedTuple

import torch
from torch import Tensor

from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.kernels.images.source_lookup import agreement as cpu_agreement
from nvsf_core.rendering.sources import SeenPoints, Sources, kernel_inputs, look_up_by_torch

_UNSEEN_DIFFERENCE = 0.25
"""Colour difference that is assumed where fewer than two sources show a point."""
_NEAREST = 2
"""This many nearest sources have weight 1 in a point's colour."""
_FARTHER_WEIGHT = 0.3
"""Weight of the other sources in a point's colour."""


class Agreement(NamedTuple):
    """How well the sources agree at d depths of each pixel."""

    found: Tensor
    """(d, h, w, 6): mean difference of all sources to their mean (spread), and difference of the two nearest
    sources (pair), 0..1; share of the sources that show the point; mean colour, 0 where none shows it."""
    colour: Tensor
    """(d, 3, h, w) colour, mostly of the nearest two of the sources that count for it; else 0."""

    @property
    def share(self) -> Tensor:
        """(d, h, w) share of the sources that show the point."""
        return self.found[..., 2]


def agreement(sources: Sources, points: SeenPoints, pinhole: Pinhole, first: int = 0) -> Agreement:
    """Compare the sources at points of a view; `first` is the first source that counts for the colour."""
    weight = torch.full((len(sources.chosen),), _FARTHER_WEIGHT)
    weight[: first + _NEAREST] = 1.0
    weight[:first] = 0.0
    if sources.images.device.type != "cpu":
        return _agreement(*look_up_by_torch(sources, points, pinhole), weight)
    agreed, colour = cpu_agreement(
        kernel_inputs(sources, points, pinhole), _UNSEEN_DIFFERENCE, weight.numpy()
    )
    return Agreement(torch.from_numpy(agreed), torch.from_numpy(colour).permute(0, 3, 1, 2))


def _agreement(colour: Tensor, seen: Tensor, weight: Tensor) -> Agreement:
    """The same, from colours (k, 3, d, h, w) and whether they are shown (k, d, h, w), on any device."""
    shown = seen[:, None].float()
    count = shown.sum(dim=0)
    mean = (colour * shown).sum(dim=0) / count.clamp_min(1e-6)
    spread = ((colour - mean).abs().mean(dim=1) * shown[:, 0]).sum(dim=0)
    count = count[0]
    spread = torch.where(count > 1.5, spread / count.clamp_min(1e-6), _UNSEEN_DIFFERENCE)
    pair = spread
    if len(shown) > 1:
        pair = torch.where(seen[0] & seen[1], (colour[0] - colour[1]).abs().mean(dim=0), _UNSEEN_DIFFERENCE)
    share = weight.to(colour.device)[:, None, None, None, None] * shown
    blended = (share * colour).sum(dim=0) / share.sum(dim=0).clamp_min(1e-6)
    found = torch.stack([spread, pair, count / len(shown), *mean], dim=-1)
    return Agreement(found, blended.transpose(0, 1))
