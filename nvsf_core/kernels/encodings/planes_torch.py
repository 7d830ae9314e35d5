"""Bilinear interpolation in a feature plane in plain torch: slow, differentiable, the kernels' oracle."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["sample"]


def sample(coordinates: Tensor, plane: Tensor) -> Tensor:
    """Interpolate in a plane (features, height, width) at (n, 2), as `nvsf_core.kernels.planes_sample`."""
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
