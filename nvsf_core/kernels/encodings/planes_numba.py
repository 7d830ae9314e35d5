"""Bilinear interpolation in a feature plane and the plane's gradient on the CPU, compiled by numba.

The kernels take planes as (height, width, features), so that a grid point's features are one vector; each
call transposes the plane once.

Results are bit-identical for every thread count and run: the forward pass is parallel over blocks of points,
the adjoint over groups of features, never over points, and each group adds its points in their order.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import torch
from numba import prange
from torch import Tensor

from nvsf_core.kernels.encodings.corners_numba import (
    BLOCK,
    axis_by_axis,
    combine,
    compiled,
    corner_scratch,
    neutral_axes,
    place,
)
from nvsf_core.kernels.encodings.planes_slope_numba import coordinate_adjoint
from nvsf_core.kernels.encodings.rows_numba import gather, scatter

__all__ = ["adjoint", "coordinate_adjoint", "sample"]

_CORNERS = 4
_NO_SHIFT = np.float32(0.0)
_NO_MASK = np.uint32(0xFFFFFFFF)


@cache
def _forward_for(features: int) -> Any:
    """The forward kernel with the number of features known to the compiler."""

    def forward(axes: Any, plane: Any, scales: Any, lasts: Any, factors: Any, points: Any, out: Any) -> None:
        for block in prange((points + BLOCK - 1) // BLOCK):
            key, share = neutral_axes()
            entry, weight = corner_scratch(_CORNERS)
            first = block * BLOCK
            count = min(BLOCK, points - first)
            for axis in range(factors.shape[0]):
                place(
                    axes, axis * points + first, count, axis, scales[axis], _NO_SHIFT, lasts[axis],
                    factors[axis], key, share,
                )  # fmt: skip
            combine(key, share, count, factors.shape[0], True, _NO_MASK, entry, weight)
            for i in range(count):
                start = (first + i) * features
                gather(plane, entry, weight, i, out, start, _CORNERS, BLOCK, features, features)

    return compiled(forward)


@cache
def _adjoint_for(features: int, group: int) -> Any:
    """The adjoint kernel with the number of features, in all and in a group, known to the compiler."""

    def adjoint(
        axes: Any, grad: Any, scales: Any, lasts: Any, factors: Any, points: Any, grad_plane: Any
    ) -> None:
        for part in prange(features // group):
            key, share = neutral_axes()
            entry, weight = corner_scratch(_CORNERS)
            plane = grad_plane[part * group :]
            for first in range(0, points, BLOCK):
                count = min(BLOCK, points - first)
                for axis in range(factors.shape[0]):
                    place(
                        axes, axis * points + first, count, axis, scales[axis], _NO_SHIFT, lasts[axis],
                        factors[axis], key, share,
                    )  # fmt: skip
                combine(key, share, count, factors.shape[0], True, _NO_MASK, entry, weight)
                for i in range(count):
                    start = (first + i) * features + part * group
                    scatter(plane, entry, weight, i, grad, start, _CORNERS, BLOCK, features, group)

    return compiled(adjoint)


def _axis_arrays(height: int, width: int) -> tuple[Any, ...]:
    """Cells, last grid point and distance of neighbours in memory, along the width and the height."""
    lasts = np.array([width - 1, height - 1], dtype=np.uint32)
    return lasts.astype(np.float32), lasts, np.array([1, width], dtype=np.uint32)


def sample(coordinates: Tensor, plane: Tensor) -> Tensor:
    """Interpolate in a float32 CPU plane (features, height, width) at (n, 2), without autograd.

    Arguments and result as in `nvsf_core.kernels.planes_sample`.
    """
    features, height, width = plane.shape
    points = coordinates.shape[0]
    out = np.empty((points, features), dtype=np.float32)
    _forward_for(features)(
        axis_by_axis(coordinates),
        plane.detach().permute(1, 2, 0).contiguous().view(-1).numpy(),
        *_axis_arrays(height, width),
        points,
        out.reshape(-1),
    )
    return torch.from_numpy(out)


def adjoint(coordinates: Tensor, grad: Tensor, shape: torch.Size) -> Tensor:
    """Gradient of the plane from the gradient of the result.

    Args:
        coordinates: (n, 2) float32 on the CPU.
        grad: (n, features) float32 on the CPU.
        shape: (features, height, width) of the plane.

    Returns:
        (features, height, width) float32; bit-identical for every thread count.
    """
    features, height, width = shape
    grad_plane = np.zeros((height, width, features), dtype=np.float32)
    # Two groups if the number is even: more would compute the corners more often than they gain.
    group = features // 2 if features % 2 == 0 else features
    _adjoint_for(features, group)(
        axis_by_axis(coordinates),
        grad.detach().contiguous().view(-1).numpy(),
        *_axis_arrays(height, width),
        coordinates.shape[0],
        grad_plane.reshape(-1),
    )
    return torch.from_numpy(grad_plane).permute(2, 0, 1).contiguous()
