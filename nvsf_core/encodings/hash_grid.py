"""A trainable multiresolution hash grid (Müller et al. 2022)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from nvsf_core.kernels import Backend, GridLayout, hash_grid_encode
from nvsf_core.recipe import FieldSpec

INITIAL_BOUND = 1e-4
"""Initial entries are uniform within plus/minus this (as in tiny-cuda-nn)."""


def grid_layout(spec: FieldSpec, edge_m: float) -> GridLayout:
    """The hash grid whose cells have the recipe's sizes in a cube of edge `edge_m`."""
    return GridLayout(
        levels=spec.levels,
        features=spec.features,
        log2_table=spec.log2_table,
        base_resolution=max(2, round(edge_m / spec.coarsest_cell_m)),
        finest_resolution=max(4, round(edge_m / spec.finest_cell_m)),
    )


class HashGrid(nn.Module):
    """Hash-grid features of positions in the unit box (or square), from a trainable table.

    Two grids of one layout, made one after the other from one generator, start with different numbers
    (the authors seed every module with 1337, so theirs start equal).

    Attributes:
        layout: Sizes of the grid.
        table: (layout.entries, layout.features) float32, initially U(-1e-4, 1e-4).
    """

    def __init__(
        self, layout: GridLayout, generator: torch.Generator, backend: Backend | None = None
    ) -> None:
        """Sample the table's initial numbers.

        Args:
            layout: Sizes of the grid.
            generator: On the CPU; the only source of randomness.
            backend: Overrides the choice of the kernel, for tests.
        """
        super().__init__()
        self.layout = layout
        self.backend = backend
        shape = (layout.entries, layout.features)
        if torch.get_default_device().type == "meta":  # shapes without memory, to count parameters
            table = torch.empty(shape)
        else:
            # numpy, unlike torch, requests huge pages: look-ups in a large table are up to 1.5 times faster
            table = torch.from_numpy(np.empty(shape, dtype=np.float32))
        self.table = nn.Parameter(table.uniform_(-INITIAL_BOUND, INITIAL_BOUND, generator=generator))

    @property
    def outputs(self) -> int:
        """Length of a position's encoding."""
        return self.layout.outputs

    def forward(self, positions: Tensor) -> Tensor:
        """Encode positions (..., layout.dimensions), clamped to [0, 1], as (..., levels * features)."""
        flat = positions.reshape(-1, self.layout.dimensions)
        encoded = hash_grid_encode(flat, self.table, self.layout, backend=self.backend)
        return encoded.reshape(*positions.shape[:-1], self.outputs)


def start_alike(module: nn.Module) -> None:
    """Give all grids of one layout in a module equal numbers, as in the authors' code (one seed for all)."""
    first: dict[GridLayout, Tensor] = {}
    for grid in module.modules():
        if isinstance(grid, HashGrid):
            with torch.no_grad():
                grid.table.copy_(first.setdefault(grid.layout, grid.table))
