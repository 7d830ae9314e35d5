"""Small networks, with weights drawn from an explicit generator."""

import itertools
import math
from typing import cast

import torch
from torch import Tensor, nn


def network(sizes: tuple[int, ...], generator: torch.Generator, *, silent: int = 0) -> nn.Sequential:
    """Linear layers with ReLU between them; the first `silent` outputs are exactly 0 before training.

    A silent output is a correction: before anything is learned, the evidence stands as it is.
    """
    layers: list[nn.Module] = []
    for fan_in, fan_out in itertools.pairwise(sizes):
        layer = nn.Linear(fan_in, fan_out)
        bound = math.sqrt(6.0 / fan_in)
        with torch.no_grad():
            layer.weight.uniform_(-bound, bound, generator=generator)
            layer.bias.zero_()
        layers += [layer, nn.ReLU()]
    last = cast(nn.Linear, layers[-2])
    with torch.no_grad():
        last.weight *= 0.3
        last.weight[:silent] = 0.0
    return nn.Sequential(*layers[:-1])


def scatter_rows(values: Tensor, mask: Tensor) -> Tensor:
    """Put rows (m, c) where `mask` (r, k) is true; 0 elsewhere: (r, k, c)."""
    full = values.new_zeros(*mask.shape, values.shape[-1])
    full[mask] = values
    return full
