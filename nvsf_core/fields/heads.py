"""The radiance networks: what a point answers in a direction (paper, Fig. 2, item 5)."""

from typing import cast

import torch
from torch import Tensor, nn
from torch.nn.functional import linear

from nvsf_core.encodings.frequency import frequency_encode
from nvsf_core.fields.layers import bias_free
from nvsf_core.recipe import HeadsSpec


class Head(nn.Module):
    """One radiance network: encoded direction and geometry features to values in 0..1; two hidden layers."""

    def __init__(self, directions: int, outputs: int, spec: HeadsSpec, generator: torch.Generator) -> None:
        """Draw all weights; `directions` is the length of the encoded direction."""
        super().__init__()
        self.directions = directions
        sizes = (directions + spec.geometry_features, spec.hidden, spec.hidden, outputs)
        self.network = bias_free(sizes, generator)

    def forward(self, direction: Tensor, geometry: Tensor) -> Tensor:
        """Encoded directions (..., d) and geometry features (..., g) to (..., outputs).

        Leading axes broadcast: a direction (r, 1, d) is worked on once for all samples (r, s, g) of its ray.
        """
        first = cast(nn.Linear, self.network[0]).weight
        of_direction = linear(direction, first[:, : self.directions])
        hidden = of_direction + linear(geometry, first[:, self.directions :])
        return torch.sigmoid(self.network[1:](hidden))


def lidar_direction(direction: Tensor, frequencies: int) -> Tensor:
    """Unit vectors (..., 3), moved into 0..1, as (..., 6 * frequencies) sines and cosines of octaves."""
    return frequency_encode(0.5 * (direction + 1.0), frequencies)
