"""Small networks with weights from an explicit random generator, and the paper's heads."""

import itertools
import math
from typing import Literal, TypeVar, cast

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.functional import linear

from nvsf_core.numerics import safe_exp
from nvsf_core.recipe.paper import HeadsSpec
from nvsf_core.recipe.residual import HitsSpec, PanoSpec

_Layer = TypeVar("_Layer", bound=nn.Module)


def network(sizes: tuple[int, ...], generator: torch.Generator, *, zero_outputs: int = 0) -> nn.Sequential:
    """Linear layers of the given `sizes`, inputs first, with ReLU between them.

    The first `zero_outputs` outputs are exactly 0 before training: as corrections they leave the evidence
    unchanged.
    """
    layers: list[nn.Module] = []
    for fan_in, fan_out in itertools.pairwise(sizes):
        layer = nn.Linear(fan_in, fan_out)
        bound = math.sqrt(6.0 / fan_in)
        with torch.no_grad():
            layer.weight.uniform_(-bound, bound, generator=generator)
            layer.bias.zero_()
        # In place saves a copy of the widest arrays: the layer before needs its inputs only, not its result.
        layers += [layer, nn.ReLU(inplace=True)]
    last = cast(nn.Linear, layers[-2])
    with torch.no_grad():
        last.weight *= 0.3
        last.weight[:zero_outputs] = 0.0
    return nn.Sequential(*layers[:-1])


def undrawn(kind: type[_Layer], *sizes: int, **options: int | tuple[int, ...]) -> _Layer:
    """A layer whose weights the caller must set; torch's global generator is left as it was.

    `torch.nn.utils.skip_init` would not draw at all, and import sympy for it: two seconds in each process.
    """
    with torch.random.fork_rng(devices=[]):
        return kind(*sizes, **options)


def bias_free(
    sizes: tuple[int, ...], generator: torch.Generator, start: Literal["xavier", "kaiming"] = "xavier"
) -> nn.Sequential:
    """Linear layers without biases, with ReLU between them, as in all of the paper's networks.

    Args:
        sizes: Number of inputs, widths of the hidden layers, number of outputs.
        generator: The only source of randomness.
        start: Weights uniform within ``sqrt(6 / (in + out))`` (xavier) or ``1 / sqrt(in)`` (torch's default).
    """
    layers: list[nn.Module] = []
    for fan_in, fan_out in itertools.pairwise(sizes):
        layer = undrawn(nn.Linear, fan_in, fan_out, bias=False)
        bound = math.sqrt(6.0 / (fan_in + fan_out)) if start == "xavier" else 1.0 / math.sqrt(fan_in)
        nn.init.uniform_(layer.weight, -bound, bound, generator=generator)
        # In place saves memory: the gradient of the layer before needs its inputs only, not its result.
        layers += [layer, nn.ReLU(inplace=True)]
    return nn.Sequential(*layers[:-1])


class Head(nn.Module):
    """Network from encoded direction and geometry features to values in 0..1; two hidden layers."""

    def __init__(self, directions: int, outputs: int, spec: HeadsSpec, generator: torch.Generator) -> None:
        """Sample all weights from `generator`; `directions` is the length of the encoded direction."""
        super().__init__()
        self.directions = directions
        sizes = (directions + spec.geometry_features, spec.hidden, spec.hidden, outputs)
        self.network = bias_free(sizes, generator)

    def forward(self, direction: Tensor, geometry: Tensor) -> Tensor:
        """Values (..., outputs) of encoded directions (..., d) and geometry features (..., g).

        Leading axes broadcast: directions (r, 1, d) are multiplied once for all samples (r, s, g) of a ray.
        """
        first = cast(nn.Linear, self.network[0]).weight
        of_direction = linear(direction, first[:, : self.directions])
        hidden = of_direction + linear(geometry, first[:, self.directions :])
        return torch.sigmoid(self.network[1:](hidden))


class Density(nn.Module):
    """Network for sigma of eq. 3 and geometry features for the heads: one hidden layer, no biases."""

    def __init__(self, inputs: int, spec: HeadsSpec, generator: torch.Generator) -> None:
        """Sample all weights from `generator`."""
        super().__init__()
        self.network = bias_free((inputs, spec.hidden, 1 + spec.geometry_features), generator)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Density sigma = exp(h_0), (n,) per scaled unit, and geometry features (n, g) of (n, inputs)."""
        h = self.network(features)
        return safe_exp(h[:, 0]), h[:, 1:]


class CellNetwork(nn.Module):
    """3 x 3 convolutions with ReLU between them; columns wrap around, border rows are repeated.

    Before training the corrections are 0. Letting it also choose another range than the median of a pano's
    cell was tried: it never did, because no other range has a smaller mean error.
    """

    def __init__(
        self, features: int, outputs: int, spec: HitsSpec | PanoSpec, generator: torch.Generator
    ) -> None:
        """Sample all weights from `generator`; a cell has `features` inputs and `outputs` corrections."""
        super().__init__()
        sizes = (features, *[spec.channels] * spec.layers, outputs)
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
        around = len(self.layers)
        x = functional.pad(features, (around, around, 0, 0), mode="circular")
        # With a cell's channels side by side in memory, convolutions take half the time on a CPU.
        x = x.contiguous(memory_format=torch.channels_last)
        for number, layer in enumerate(self.layers):
            x = layer(functional.pad(x, (0, 0, 1, 1), mode="replicate"))
            if number + 1 < len(self.layers):
                x = functional.relu(x)
        return x
