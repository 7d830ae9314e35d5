"""Small networks, with weights drawn from an explicit generator."""

import itertools
import math
from typing import Literal, TypeVar, cast

import torch
from torch import nn

_Layer = TypeVar("_Layer", bound=nn.Module)


def network(sizes: tuple[int, ...], generator: torch.Generator, *, zero_outputs: int = 0) -> nn.Sequential:
    """Linear layers with ReLU between them; the first `zero_outputs` outputs are exactly 0 before training.

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
        last.weight[:zero_outputs] = 0.0
    return nn.Sequential(*layers[:-1])


def undrawn(kind: type[_Layer], *sizes: int, **options: int | bool) -> _Layer:
    """A layer whose weights are still to be drawn; torch's global generator is left alone."""
    return cast(_Layer, nn.utils.skip_init(kind, *sizes, **options))  # type: ignore[no-untyped-call]


def bias_free(
    sizes: tuple[int, ...], generator: torch.Generator, start: Literal["xavier", "kaiming"] = "xavier"
) -> nn.Sequential:
    """Linear layers without biases, with ReLU between them: the form of all the paper's networks.

    Args:
        sizes: Inputs, widths of the hidden layers, outputs.
        generator: The only source of randomness.
        start: Weights uniform within ``sqrt(6 / (in + out))`` (xavier) or ``1 / sqrt(in)`` (torch's own).
    """
    layers: list[nn.Module] = []
    for fan_in, fan_out in itertools.pairwise(sizes):
        layer = undrawn(nn.Linear, fan_in, fan_out, bias=False)
        bound = math.sqrt(6.0 / (fan_in + fan_out)) if start == "xavier" else 1.0 / math.sqrt(fan_in)
        nn.init.uniform_(layer.weight, -bound, bound, generator=generator)
        # In place: a product needs its inputs for the gradient, never its result.
        layers += [layer, nn.ReLU(inplace=True)]
    return nn.Sequential(*layers[:-1])
