"""The radiance networks: what a point answers in a direction (paper, Fig. 2, item 5)."""

from typing import cast

import torch
from torch import Tensor, nn
from torch.nn.functional import linear

from nvsf_core.encodings import SPHERICAL_HARMONICS_OUTPUTS, frequency_encode, frequency_outputs
from nvsf_core.errors import RecipeError
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


def lidar_head(spec: HeadsSpec, generator: torch.Generator) -> Head:
    """Intensity or hit probability, from frequencies of the direction."""
    return Head(frequency_outputs(3, spec.lidar_frequencies), 1, spec, generator)


def colour_head(spec: HeadsSpec, generator: torch.Generator) -> Head:
    """Red, green, blue, from spherical harmonics of the direction.

    Raises:
        RecipeError: The harmonics' degree is not 4, the only one there is.
    """
    if spec.camera_degree**2 != SPHERICAL_HARMONICS_OUTPUTS:
        raise RecipeError(f"heads.camera_degree: expected 4, found {spec.camera_degree}; correct the recipe")
    return Head(SPHERICAL_HARMONICS_OUTPUTS, 3, spec, generator)


def lidar_direction(direction: Tensor, spec: HeadsSpec) -> Tensor:
    """Unit vectors (..., 3), moved into 0..1, as (..., 72) sines and cosines of octaves."""
    return frequency_encode(0.5 * (direction + 1.0), spec.lidar_frequencies)
