"""A small network over the cells of a pano: what returns, and how brightly."""

import itertools
import math
from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from nvsf_core.fields.layers import undrawn
from nvsf_core.recipe import PanoSpec

FEATURES = 16
"""Channels that describe a cell."""


@dataclass(frozen=True, slots=True)
class PanoCorrection:
    """Corrections of panos (b, h, w)."""

    hit_logit: Tensor
    """(b, h, w), added to the logit of the expected hit."""
    intensity_logit: Tensor
    """(b, h, w), added to the logit of the expected intensity."""


class PanoNetwork(nn.Module):
    """Convolutions of 3 x 3 with ReLU between them; columns go round, rows end in copies of themselves.

    Silent before training: the corrections are 0. To choose another range than the median of what a cell
    shows was tried too: the network never did, as no other errs less.
    """

    def __init__(self, spec: PanoSpec, generator: torch.Generator) -> None:
        """Draw all weights from `generator`."""
        super().__init__()
        width = spec.channels
        sizes = (FEATURES, *[width] * spec.layers, 2)
        self.layers = nn.ModuleList(
            undrawn(nn.Conv2d, fan_in, fan_out, 3) for fan_in, fan_out in itertools.pairwise(sizes)
        )
        with torch.no_grad():
            for layer in self.layers:
                convolution = cast(nn.Conv2d, layer)
                bound = math.sqrt(6.0 / convolution.weight[0].numel())
                convolution.weight.uniform_(-bound, bound, generator=generator)
                cast(Tensor, convolution.bias).zero_()
            cast(nn.Conv2d, self.layers[-1]).weight.zero_()

    def forward(self, features: Tensor) -> PanoCorrection:
        """Corrections of panos with `features` (b, FEATURES, h, w)."""
        x = features
        for number, layer in enumerate(self.layers):
            x = functional.pad(x, (1, 1, 0, 0), mode="circular")
            x = layer(functional.pad(x, (0, 0, 1, 1), mode="replicate"))
            if number + 1 < len(self.layers):
                x = functional.relu(x)
        return PanoCorrection(x[:, 0], x[:, 1])
