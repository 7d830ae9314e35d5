"""A trainable multiresolution hash grid."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from nvsf_core.kernels import Backend, GridLayout, hash_grid_encode

__all__ = ["INITIAL_BOUND", "HashGrid", "start_alike"]

INITIAL_BOUND = 1e-4
"""Entries start uniform in plus/minus this (tiny-cuda-nn)."""


class HashGrid(nn.Module):
    """Hash-grid features of positions in the unit box (or square), with a table that trains.

    Two grids of the same layout start differently when they are given the same generator one after the
    other (the authors seed every module with 1337, so theirs start identical).

    Attributes:
        layout: the grid.
        table: (layout.entries, layout.features) float32, initially U(-1e-4, 1e-4).
    """

    def __init__(
        self, layout: GridLayout, generator: torch.Generator, backend: Backend | None = None
    ) -> None:
        """Draw the table.

        Args:
            layout: the grid.
            generator: a CPU generator; the only source of randomness.
            backend: overrides the kernel's choice, for tests.
        """
        super().__init__()
        self.layout = layout
        self.backend = backend
        shape = (layout.entries, layout.features)
        if torch.get_default_device().type == "meta":  # shapes without memory, to count parameters
            table = torch.empty(shape)
        else:
            # numpy, unlike torch, asks for huge pages: look-ups in a large table are up to 1.5 times faster
            table = torch.from_numpy(np.empty(shape, dtype=np.float32))
        self.table = nn.Parameter(table.uniform_(-INITIAL_BOUND, INITIAL_BOUND, generator=generator))

    @property
    def outputs(self) -> int:
        """Numbers in the encoding of a position."""
        return self.layout.outputs

    def forward(self, positions: Tensor) -> Tensor:
        """Encode (..., layout.dimensions) positions in [0, 1] (clamped) as (..., levels * features)."""
        flat = positions.reshape(-1, self.layout.dimensions)
        encoded = hash_grid_encode(flat, self.table, self.layout, backend=self.backend)
        return encoded.reshape(*positions.shape[:-1], self.outputs)


def start_alike(module: nn.Module) -> None:
    """Give all grids of one layout in a module the same numbers (the authors seed every module with 1337)."""
    first: dict[GridLayout, Tensor] = {}
    for grid in module.modules():
        if isinstance(grid, HashGrid):
            with torch.no_grad():
                grid.table.copy_(first.setdefault(grid.layout, grid.table))
