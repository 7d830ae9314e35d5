"""The dynamic hash: rows of plane hash grids along time (paper, Fig. 2, 4D hybrid encoding)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from nvsf_core.encodings.hash_grid import HashGrid
from nvsf_core.encodings.lagrange import NODES, cubic_basis
from nvsf_core.errors import RecipeError
from nvsf_core.kernels import GridLayout, hash_grid_encode
from nvsf_core.recipe import TimeGridSpec

__all__ = ["SPACE_PLANES", "HashTime", "contract_nodes", "two_slices"]

SPACE_PLANES = (slice(0, 2), slice(0, 3, 2), slice(1, 3))
"""Axes of the planes xy, xz, yz, as views of positions (n, 3)."""


def two_slices(t: float, slices: int) -> list[tuple[int, float]]:
    """The slices on both sides of a time and their weights; one alone where the time is a slice's own.

    A slice without weight is left out: it gets no gradient instead of a zero one, and an optimiser with
    momentum then leaves it alone.
    """
    place = t * (slices - 1)
    lower = int(place)
    share = place - lower
    return [(lower, 1.0 - share)] + ([(lower + 1, share)] if share > 0.0 else [])


def contract_nodes(table: Tensor, basis: Tensor) -> Tensor:
    """Entries (e, 4 * f), node by node, weighted with a basis (4,) and summed over the nodes: (e, f)."""
    kept = table.shape[1] // len(NODES)
    weights = torch.kron(basis[:, None], torch.eye(kept, dtype=basis.dtype))
    return table @ weights.to(table)


class HashTime(nn.Module):
    """Three planes, each a row of 2-D hash grids; an entry holds values at the four nodes of the time basis.

    ``f(x, t) = concat over planes p and levels l of sum_j L_j(t) blend_t(grid_{p,slice,l}(x_p))_j``.

    A batch has one time and a grid is linear in its table. So the tables are blended and contracted over time
    first, and positions are encoded once with one feature a level: the same numbers as two look-ups of four
    features each, with an eighth of the fetches.
    """

    def __init__(self, spec: TimeGridSpec, generator: torch.Generator) -> None:
        """Draw all tables, plane by plane, slice by slice.

        Raises:
            RecipeError: An entry does not hold the four nodes, or there is no slice.
        """
        super().__init__()
        if spec.features != len(NODES) or spec.slices < 1:
            raise RecipeError(
                f"HashTime: expected {len(NODES)} features (the nodes of the time basis) and at least one "
                f"slice, found {spec}; correct the recipe's dynamic grid"
            )
        self.spec = spec
        stored = [self._layout(log2_table, spec.features) for log2_table in spec.log2_tables]
        self.contracted = [self._layout(log2_table, 1) for log2_table in spec.log2_tables]
        self.planes = nn.ModuleList(
            nn.ModuleList(HashGrid(layout, generator) for _ in range(spec.slices)) for layout in stored
        )

    def _layout(self, log2_table: int, features: int) -> GridLayout:
        spec = self.spec
        resolutions = (spec.base_resolution, spec.finest_resolution)
        return GridLayout(spec.levels, features, log2_table, *resolutions, dimensions=2)

    @property
    def outputs(self) -> int:
        """Numbers in the encoding of a position."""
        return len(SPACE_PLANES) * self.spec.levels

    def forward(self, x01: Tensor, t: float) -> Tensor:
        """Encode (n, 3) positions in the unit cube (clamped) at a time in [0, 1]: (n, 3 * levels)."""
        return torch.cat(
            [
                hash_grid_encode(x01[:, axes], self.table_at(plane, t), self.contracted[plane])
                for plane, axes in enumerate(SPACE_PLANES)
            ],
            dim=1,
        )

    def table_at(self, plane: int, t: float) -> Tensor:
        """A plane's table at a time, (entries, 1)."""
        grids, basis = self.planes[plane], cubic_basis(t)
        parts = [
            contract_nodes(grids[index].table, weight * basis)  # type: ignore[index]
            for index, weight in two_slices(t, self.spec.slices)
        ]
        return parts[0] if len(parts) == 1 else parts[0] + parts[1]
