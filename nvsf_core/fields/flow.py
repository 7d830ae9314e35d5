"""The scene-flow network: displacement of points to the next and previous frame (paper, Fig. 2; eq. 5)."""

from dataclasses import replace

import torch
from torch import Tensor, nn

from nvsf_core.encodings.hash_time import NODES, contract_nodes, cubic_basis
from nvsf_core.encodings.hybrid import grid_of
from nvsf_core.errors import RecipeError
from nvsf_core.fields.layers import bias_free
from nvsf_core.kernels.encodings.hash_grid import HashGrid, hash_grid_encode
from nvsf_core.recipe.paper import FlowSpec, ReferenceQuirks

_LAST_LAYER_STD = 1e-3
"""Standard deviation of the last layer's initial weights: the flow starts near 0."""


class FlowField(nn.Module):
    """MLP_flow of eq. 5: trained so that ``S_i + MLP_flow(S_i)`` fits the clouds of neighbouring frames.

    Each entry of its hash grid holds values at the four nodes of the time basis. All points of a batch have
    one time, so the table is first contracted over the nodes, and positions are encoded with a quarter of
    the features; the result is the same.
    """

    def __init__(self, spec: FlowSpec, generator: torch.Generator) -> None:
        """Sample all weights from `generator`.

        Raises:
            RecipeError: The grid's number of features is no multiple of four (the nodes).
        """
        super().__init__()
        stored = grid_of(spec.grid)
        if stored.features % len(NODES):
            raise RecipeError(
                f"FlowField: expected features in multiples of {len(NODES)} (the nodes of the time basis), "
                f"found {stored.features}; correct the recipe's flow grid"
            )
        self.contracted = replace(stored, features=stored.features // len(NODES))
        self.grid = HashGrid(stored, generator)
        sizes = (self.contracted.outputs, spec.hidden, spec.hidden, 6)
        self.network = bias_free(sizes, generator, start="kaiming")
        nn.init.normal_(self.network[-1].weight, std=_LAST_LAYER_STD, generator=generator)  # type: ignore[arg-type]

    def forward(self, x01: Tensor, t: float) -> tuple[Tensor, Tensor]:
        """Displacements (n, 3), scaled units, at a time in [0, 1] to the next and to the previous frame.

        Positions (n, 3) are in the unit cube (clamped).
        """
        table = contract_nodes(self.grid.table, cubic_basis(t))
        both = self.network(hash_grid_encode(x01, table, self.contracted))
        return both[:, :3], both[:, 3:]


def applied(displacement: Tensor, slips: ReferenceQuirks) -> Tensor:
    """A displacement (n, 3) in scaled units, converted to the unit cube, which spans ``2 * bound`` of them.

    The authors' code adds it unconverted (`slips.flow_unit`): 2 * bound times too far.
    """
    return displacement if slips.flow_unit else displacement / (2.0 * slips.bound)
