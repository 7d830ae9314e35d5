"""Bilinear interpolation in a feature plane, and both gradients of it, on the CPU, compiled by numba.

The kernels take planes as (height, width, features), so that a grid point's features are one vector; each
call transposes the plane once.

Results are bit-identical for every thread count and run: the forward pass is parallel over blocks of points,
the adjoint over groups of features, never over points, and each group adds its points in their order. The
gradient of the coordinates, by which a loss moves points (the paper's flow), is parallel over points, each
with a sum of its own.
"""

from functools import cache
from typing import Any

import numpy as np
import torch
from numba import prange
from torch import Tensor

from nvsf_core.kernels.encodings.corners_numba import (
    BLOCK,
    axis_by_axis,
    compiled,
    corner_scratch,
    place_corners,
)
from nvsf_core.kernels.encodings.rows_numba import gather, scatter

_CORNERS = 4
_NO_SHIFT = np.float32(0.0)
_NO_MASK = np.uint32(0xFFFFFFFF)


@cache
def _forward_for(features: int) -> Any:
    """The forward kernel with the number of features known to the compiler."""

    def forward(axes: Any, plane: Any, scales: Any, lasts: Any, factors: Any, points: Any, out: Any) -> None:
        for block in prange((points + BLOCK - 1) // BLOCK):
            scratch = corner_scratch(_CORNERS)
            first = block * BLOCK
            count = min(BLOCK, points - first)
            entry, weight = place_corners(
                axes, points, first, count, scales, _NO_SHIFT, lasts, factors, True, _NO_MASK, scratch
            )
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
            scratch = corner_scratch(_CORNERS)
            plane = grad_plane[part * group :]
            for first in range(0, points, BLOCK):
                count = min(BLOCK, points - first)
                entry, weight = place_corners(
                    axes, points, first, count, scales, _NO_SHIFT, lasts, factors, True, _NO_MASK, scratch
                )
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

    Arguments and result as in `planes.planes_sample`.
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
    """Gradient (features, height, width) float32 of the plane, bit-identical for every thread count.

    From float32 coordinates (n, 2) and the gradient (n, features) float32 of the result, on the CPU.
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


@cache
def _slope_for(feature_count: int) -> Any:
    """The kernel with the number of features known to the compiler."""
    # Unsigned: numba tests every signed index for being negative.
    features = np.uint64(feature_count)

    def slope(coordinates: Any, plane: Any, grad: Any, height: Any, width: Any, out: Any) -> None:
        zero, one = np.float32(0.0), np.float32(1.0)
        columns, rows = np.float32(width - 1), np.float32(height - 1)
        for point in prange(coordinates.shape[0]):
            x, y = coordinates[point, 0], coordinates[point, 1]
            known_x, known_y = (x if x == x else zero), (y if y == y else zero)
            u = min(max(known_x, zero), one) * columns
            v = min(max(known_y, zero), one) * rows
            left, low = np.int64(u), np.int64(v)
            right, high = min(left + 1, width - 1), min(low + 1, height - 1)
            fraction_u = u - np.float32(left) if x == x else x
            fraction_v = v - np.float32(low) if y == y else y
            a, b = np.uint64(low * width + left) * features, np.uint64(low * width + right) * features
            c, d = np.uint64(high * width + left) * features, np.uint64(high * width + right) * features
            start = np.uint64(point) * features
            along_u, along_v = zero, zero
            for f in range(feature_count):
                k = np.uint64(f)
                g, at_a, at_b, at_c, at_d = (
                    grad[start + k],
                    plane[a + k],
                    plane[b + k],
                    plane[c + k],
                    plane[d + k],
                )
                along_u += g * ((one - fraction_v) * (at_b - at_a) + fraction_v * (at_d - at_c))
                along_v += g * ((one - fraction_u) * (at_c - at_a) + fraction_u * (at_d - at_b))
            # Clamped coordinates and NaN have no gradient.
            out[point, 0] = along_u * columns if zero <= x and x <= one else zero
            out[point, 1] = along_v * rows if zero <= y and y <= one else zero

    return compiled(slope)


def coordinate_adjoint(coordinates: Tensor, plane: Tensor, grad: Tensor) -> Tensor:
    """Gradient (n, 2) float32 of the coordinates, bit-identical for every thread count.

    From float32 coordinates (n, 2), plane (features, height, width) and gradient (n, features) of the result,
    on the CPU.
    """
    features, height, width = plane.shape
    out = np.empty(tuple(coordinates.shape), dtype=np.float32)
    _slope_for(features)(
        coordinates.detach().contiguous().numpy(),
        plane.detach().permute(1, 2, 0).contiguous().view(-1).numpy(),
        grad.detach().contiguous().view(-1).numpy(),
        height,
        width,
        out,
    )
    return torch.from_numpy(out)
