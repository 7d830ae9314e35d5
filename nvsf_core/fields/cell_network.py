"""A small convolutional network that corrects the values of a 360-degree range image, cell by cell."""

import itertools
import math
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from nvsf_core.fields.layers import undrawn


class CellNetwork(nn.Module):
    """3 x 3 convolutions with ReLU between them; columns wrap around, border rows are repeated.

    Before training the corrections are 0. Letting it also choose another range than the median of a pano's
    cell was tried: it never did, because no other range has a smaller mean error.
    """

    def __init__(
        self, features: int, outputs: int, generator: torch.Generator, *, channels: int, layers: int
    ) -> None:
        """Sample all weights from `generator`.

        Args:
            features: Input channels of a cell.
            outputs: Corrections a cell.
            generator: The only source of randomness.
            channels: Width of the hidden layers.
            layers: Number of hidden layers.
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

    @torch.no_grad()
    def corrections(self, features: Tensor) -> Tensor:
        """Corrections (outputs, h, w) of one image (features, h, w), both on the CPU wherever weights lie."""
        return self(features[None].to(next(self.parameters()).device))[0].cpu()

    def forward(self, features: Tensor) -> Tensor:
        """Corrections (b, outputs, h, w), to be added to logits, from `features` (b, features, h, w)."""
        x = features
        for number, layer in enumerate(self.layers):
            x = functional.pad(x, (1, 1, 0, 0), mode="circular")
            x = layer(functional.pad(x, (0, 0, 1, 1), mode="replicate"))
            if number + 1 < len(self.layers):
                x = functional.relu(x)
        return x
