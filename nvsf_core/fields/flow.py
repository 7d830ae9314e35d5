"""The scene-flow network: where a point was and will be one frame away (paper, Fig. 2, item 1; eq. 5)."""

import torch
from torch import Tensor, nn

from nvsf_core.encodings.hash_grid import HashGrid
from nvsf_core.encodings.hash_time import NODES, contract_nodes, cubic_basis
from nvsf_core.encodings.hybrid import grid_of
from nvsf_core.errors import RecipeError
from nvsf_core.fields.layers import bias_free
from nvsf_core.kernels import GridLayout, hash_grid_encode
from nvsf_core.recipe import FlowSpec, ReferenceQuirks

_LAST_LAYER_STD = 1e-3
"""Of the last layer's weights: the flow starts near 0."""


class FlowField(nn.Module):
    """MLP_flow of eq. 5: ``S_i + MLP_flow(S_i)`` is laid onto the clouds of the frames before and after.

    A hash grid of its own holds the four nodes of the time basis in each entry. A batch has one time, so the
    table is contracted over them first and positions are encoded with a quarter of the features: the same
    numbers.
    """

    def __init__(self, spec: FlowSpec, generator: torch.Generator) -> None:
        """Draw all weights.

        Raises:
            RecipeError: The grid's features are no multiple of the four nodes.
        """
        super().__init__()
        stored = grid_of(spec.grid)
        if stored.features % len(NODES):
            raise RecipeError(
                f"FlowField: expected features in multiples of {len(NODES)} (the nodes of the time basis), "
                f"found {stored.features}; correct the recipe's flow grid"
            )
        self.contracted = GridLayout(
            stored.levels,
            stored.features // len(NODES),
            stored.log2_table,
            stored.base_resolution,
            stored.finest_resolution,
        )
        self.grid = HashGrid(stored, generator)
        sizes = (self.contracted.outputs, spec.hidden, spec.hidden, 6)
        self.network = bias_free(sizes, generator, start="kaiming")
        nn.init.normal_(self.network[-1].weight, std=_LAST_LAYER_STD, generator=generator)  # type: ignore[arg-type]

    def forward(self, x01: Tensor, t: float) -> tuple[Tensor, Tensor]:
        """Displacements to the next and to the previous frame of positions at one time.

        Args:
            x01: (n, 3) in the unit cube (clamped).
            t: In [0, 1].

        Returns:
            Forward and backward displacement, each (n, 3), scaled units a frame.
        """
        table = contract_nodes(self.grid.table, cubic_basis(t))
        both = self.network(hash_grid_encode(x01, table, self.contracted))
        return both[:, :3], both[:, 3:]


def applied(displacement: Tensor, slips: ReferenceQuirks) -> Tensor:
    """A displacement in scaled units as one in the unit cube, which spans ``2 * bound`` scaled units.

    The authors add it unchanged (`slips.flow_unit`): 2 * bound times too far.
    """
    return displacement if slips.flow_unit else displacement / (2.0 * slips.bound)
