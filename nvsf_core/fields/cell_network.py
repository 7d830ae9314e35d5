"""A small network over the cells of a turn, whose columns go round: corrections of what each cell answers."""

import itertools
import math
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from nvsf_core.fields.layers import undrawn


class CellNetwork(nn.Module):
    """Convolutions of 3 x 3 with ReLU between them; columns go round, rows end in copies of themselves.

    Silent before training: the corrections are 0. To choose another range than the median of what a pano's
    cell shows was tried too: the network never did, as no other errs less.
    """

    def __init__(
        self, features: int, outputs: int, generator: torch.Generator, *, channels: int, layers: int
    ) -> None:
        """Draw all weights from `generator`.

        Args:
            features: Channels that describe a cell.
            outputs: Corrections of a cell.
            generator: The only source of randomness.
            channels: Width.
            layers: Layers of that width.
        """
        super().__init__()
        sizes = (features, *[channels] * layers, outputs)
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

    def forward(self, features: Tensor) -> Tensor:
        """Corrections (b, outputs, h, w), added to logits, of turns with `features` (b, features, h, w)."""
        x = features
        for number, layer in enumerate(self.layers):
            x = functional.pad(x, (1, 1, 0, 0), mode="circular")
            x = layer(functional.pad(x, (0, 0, 1, 1), mode="replicate"))
            if number + 1 < len(self.layers):
                x = functional.relu(x)
        return x
