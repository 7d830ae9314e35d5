"""The dynamic hash encoding: 2-D hash grids, interpolated over time by cubic polynomials (paper, Fig. 2)."""

from __future__ import annotations

from dataclasses import replace
from math import prod

import torch
from torch import Tensor, nn

from nvsf_core.errors import RecipeError
from nvsf_core.kernels.encodings.hash_grid import GridLayout, HashGrid, hash_grid_encode
from nvsf_core.recipe.paper import TimeGridSpec

SPACE_PLANES = (slice(0, 2), slice(0, 3, 2), slice(1, 3))
"""Slices that select the coordinates xy, xz, yz of positions (n, 3), as views."""


def two_slices(t: float, slices: int) -> list[tuple[int, float]]:
    """Linear interpolation over time: numbers and weights of the slices around `t` in [0, 1].

    A slice of weight 0 is left out, so that it gets no gradient: with a gradient of 0 an optimiser with
    momentum would still change it.
    """
    place = t * (slices - 1)
    lower = int(place)
    share = place - lower
    return [(lower, 1.0 - share)] + ([(lower + 1, share)] if share > 0.0 else [])


def contract_nodes(table: Tensor, basis: Tensor) -> Tensor:
    """A table (e, 4 * f), node by node, weighted with `basis` (4,) and summed over the nodes: (e, f)."""
    kept = table.shape[1] // len(NODES)
    weights = torch.kron(basis[:, None], torch.eye(kept, dtype=basis.dtype))
    return table @ weights.to(table)


class HashTime(nn.Module):
    """2-D hash grids of three planes, several slices of time each; entries hold values at the time nodes.

    ``f(x, t) = concat over planes p and levels l of sum_j L_j(t) blend_t(grid_{p,slice,l}(x_p))_j``.

    All points of a batch have one time, and a grid is linear in its table. So the tables are blended and
    contracted over time first, and positions are encoded once with one feature a level: the same result as
    two look-ups of four features each, with an eighth of the memory reads.
    """

    def __init__(self, spec: TimeGridSpec, generator: torch.Generator) -> None:
        """Sample all tables, plane by plane, slice by slice.

        Raises:
            RecipeError: The features are not four (the nodes), or there is no slice.
        """
        super().__init__()
        if spec.features != len(NODES) or spec.slices < 1:
            raise RecipeError(
                f"HashTime: expected {len(NODES)} features (the nodes of the time basis) and at least one "
                f"slice, found {spec}; correct the recipe's dynamic grid"
            )
        self.spec = spec
        sizes = (spec.base_resolution, spec.finest_resolution)
        stored = [
            GridLayout(spec.levels, spec.features, log2_table, *sizes, dimensions=2)
            for log2_table in spec.log2_tables
        ]
        self.contracted = [replace(layout, features=1) for layout in stored]
        self.planes = nn.ModuleList(
            nn.ModuleList(HashGrid(layout, generator) for _ in range(spec.slices)) for layout in stored
        )

    @property
    def outputs(self) -> int:
        """Length of a position's encoding."""
        return len(SPACE_PLANES) * self.spec.levels

    def forward(self, x01: Tensor, t: float) -> Tensor:
        """Encode positions (n, 3) in the unit cube (clamped) at a time in [0, 1] as (n, 3 * levels)."""
        return torch.cat(
            [
                hash_grid_encode(x01[:, axes], self.table_at(plane, t), self.contracted[plane])
                for plane, axes in enumerate(SPACE_PLANES)
            ],
            dim=1,
        )

    def table_at(self, plane: int, t: float) -> Tensor:
        """Table (entries, 1) of plane 0, 1 or 2 (`SPACE_PLANES`) at a time in [0, 1]."""
        grids, basis = self.planes[plane], cubic_basis(t)
        parts = [
            contract_nodes(grids[index].table, weight * basis)  # type: ignore[index]
            for index, weight in two_slices(t, self.spec.slices)
        ]
        return parts[0] if len(parts) == 1 else parts[0] + parts[1]


NODES = (0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0)
"""Nodes of the time basis: at each, one of the four basis functions is 1 and the others are 0."""


def cubic_basis(t: float) -> Tensor:
    """Lagrange's cubic polynomials at a time: ``L_j(t) = product over k != j of (t - t_k) / (t_j - t_k)``.

    They sum to 1, and ``sum of L_j(t) f_j`` is the cubic through the values f_j at the `NODES`: one
    polynomial for the whole scene, so that distant frames are coupled (as in LiDAR4D).

    Args:
        t: In [0, 1], the scene's first and last frame.

    Returns:
        (4,) float64.

    Raises:
        ValueError: The time is outside [0, 1], where a cubic extrapolates wildly.
    """
    if not 0.0 <= t <= 1.0:
        raise ValueError(f"cubic_basis: expected a time in [0, 1], found {t}; frames are 0 to n - 1")
    values = [prod((t - other) / (node - other) for other in NODES if other != node) for node in NODES]
    return torch.tensor(values, dtype=torch.float64)
