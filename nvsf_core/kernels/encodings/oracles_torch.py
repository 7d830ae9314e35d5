"""The hash-grid encoding and the planes in plain torch: slow, differentiable, the kernels' oracles."""

import torch
from torch import Tensor

from nvsf_core.kernels.encodings.hash_grid import PRIMES, GridLayout


def encode(positions: Tensor, table: Tensor, layout: GridLayout) -> Tensor:
    """Encode positions (n, dimensions); arguments and result as in `hash_grid.hash_grid_encode`."""
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


def sample(coordinates: Tensor, plane: Tensor) -> Tensor:
    """Interpolate in a plane (features, height, width) at (n, 2), as `planes.planes_sample`."""
    features, height, width = plane.shape
    cells = torch.tensor([width - 1, height - 1], dtype=coordinates.dtype, device=coordinates.device)
    position = coordinates.clamp(0.0, 1.0) * cells
    lower = torch.floor(position.detach())
    u, v = (position - lower).unbind(dim=1)
    # A NaN coordinate has no cell: it reads grid point 0 and stays NaN through its weights.
    column, row = torch.nan_to_num(lower, nan=0.0).long().unbind(dim=1)
    points = plane.reshape(features, height * width)
    total = torch.zeros(len(coordinates), features, dtype=plane.dtype, device=plane.device)
    for corner in range(4):
        right, up = corner & 1, corner >> 1
        weight = (u if right else 1.0 - u) * (v if up else 1.0 - v)
        entry = (row + up).clamp(max=height - 1) * width + (column + right).clamp(max=width - 1)
        total = total + weight[:, None].to(plane.dtype) * points[:, entry].t()
    return total
