"""The hash-grid encoding in plain torch: slow, differentiable, the oracle that kernels are tested against."""

from __future__ import annotations

import torch
from torch import Tensor

from nvsf_core.kernels.encodings.hash_grid import PRIMES, GridLayout

__all__ = ["encode"]


def encode(positions: Tensor, table: Tensor, layout: GridLayout) -> Tensor:
    """Encode positions (n, dimensions); arguments and result as in `nvsf_core.kernels.hash_grid_encode`."""
    inside = positions.clamp(0.0, 1.0)
    return torch.cat([_encode_level(inside, table, layout, level) for level in range(layout.levels)], dim=-1)


def _encode_level(inside: Tensor, table: Tensor, layout: GridLayout, level: int) -> Tensor:
    cell_position = inside * layout.scales[level] + 0.5
    lower = torch.floor(cell_position.detach())
    fraction = cell_position - lower
    # A NaN position has no cell: it reads cell 0 and stays NaN through its weights.
    cell = torch.nan_to_num(lower, nan=0.0).long()
    total = torch.zeros(inside.shape[0], layout.features, dtype=table.dtype, device=table.device)
    for corner in range(layout.corners):
        upper = [(corner >> axis) & 1 for axis in range(layout.dimensions)]
        weight = torch.ones_like(fraction[:, 0])
        for axis in range(layout.dimensions):
            weight = weight * (fraction[:, axis] if upper[axis] else 1.0 - fraction[:, axis])
        entry = _entry([cell[:, axis] + upper[axis] for axis in range(layout.dimensions)], layout, level)
        total = total + weight[:, None].to(table.dtype) * table[entry]
    return total


def _entry(point: list[Tensor], layout: GridLayout, level: int) -> Tensor:
    """Table rows of grid points, given axis by axis: x varies fastest in dense levels, others are hashed."""
    if layout.is_dense[level]:
        resolution = layout.resolutions[level]
        *finer, entry = [coordinate.clamp(max=resolution - 1) for coordinate in point]
        for coordinate in reversed(finer):
            entry = resolution * entry + coordinate
        return layout.offsets[level] + entry
    hashed = point[0] * PRIMES[0]
    for coordinate, prime in zip(point[1:], PRIMES[1:], strict=False):
        hashed = hashed ^ (coordinate * prime)
    return layout.offsets[level] + (hashed & (layout.table_entries - 1))
