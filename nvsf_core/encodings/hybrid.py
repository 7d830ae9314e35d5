"""The paper's 4D hybrid encoding: hash grids for detail, planes for smoothness (Fig. 2, item 3)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from nvsf_core.encodings.hash_time import HashTime
from nvsf_core.encodings.planes import Planes4D
from nvsf_core.kernels.encodings.hash_grid import GridLayout, HashGrid
from nvsf_core.recipe.paper import EncoderSpec, GridSpec


def grid_of(spec: GridSpec) -> GridLayout:
    """The layout of a recipe's 3-D grid."""
    return GridLayout(
        spec.levels, spec.features, spec.log2_table, spec.base_resolution, spec.finest_resolution
    )


class HybridEncoding(nn.Module):
    """Static features (planes of space, 3-D hash grid) and dynamic ones (planes of time, dynamic hash).

    With the paper's sizes these are 32 + 32 static and 32 + 24 dynamic numbers.
    """

    def __init__(self, spec: EncoderSpec, generator: torch.Generator) -> None:
        """Sample all tables and planes."""
        super().__init__()
        self.static_hash = HashGrid(grid_of(spec.static), generator)
        self.dynamic_hash = HashTime(spec.dynamic, generator)
        self.planes = Planes4D(spec.planes, generator)

    @property
    def outputs(self) -> tuple[int, int]:
        """Lengths of a position's static and dynamic encoding."""
        planes = self.planes.outputs
        return planes + self.static_hash.outputs, planes + self.dynamic_hash.outputs

    def static(self, x01: Tensor) -> Tensor:
        """Encode positions (n, 3) in the unit cube as (n, outputs[0])."""
        return torch.cat([self.planes.static(x01), self.static_hash(x01)], dim=1)

    def dynamic(self, x01: Tensor, t: float, *, hash_gradient: bool = True) -> Tensor:
        """Encode positions at one time as (n, outputs[1]).

        Args:
            x01: (n, 3) in the unit cube; with a gradient where the flow moved them.
            t: Time in [0, 1].
            hash_gradient: False in neighbouring frames: the hash features are then constants, so that losses
                of rendering reach the positions (and the flow) through the planes only.
        """
        with torch.set_grad_enabled(hash_gradient and torch.is_grad_enabled()):
            hashed = self.dynamic_hash(x01, t)
        return torch.cat([self.planes.dynamic(x01, t), hashed], dim=1)
