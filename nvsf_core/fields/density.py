"""The NeRF network, shared by both sensors: features to density (paper, Fig. 2, item 4)."""

import torch
from torch import Tensor, nn

from nvsf_core.fields.layers import bias_free
from nvsf_core.numerics import safe_exp
from nvsf_core.recipe import HeadsSpec


class Density(nn.Module):
    """sigma of eq. 3, and geometry features for the heads: one hidden layer, no biases."""

    def __init__(self, inputs: int, spec: HeadsSpec, generator: torch.Generator) -> None:
        """Draw all weights."""
        super().__init__()
        self.network = bias_free((inputs, spec.hidden, 1 + spec.geometry_features), generator)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Features (n, inputs) to sigma = exp(h_0), (n,) per scaled unit, and geometry features (n, g)."""
        h = self.network(features)
        return safe_exp(h[:, 0]), h[:, 1:]
