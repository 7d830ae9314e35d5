"""Gradient of the coordinates of a plane's bilinear interpolation on the CPU, compiled by numba.

By it a loss moves points (the paper's flow). The kernel takes planes as (height, width, features), as in
`planes_numba`. It is parallel over points, each with a sum of its own, so results are bit-identical.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import torch
from numba import prange
from torch import Tensor

from nvsf_core.kernels.encodings.corners_numba import compiled

__all__ = ["coordinate_adjoint"]


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
    """Gradient of the coordinates from the gradient of the result.

    Args:
        coordinates: (n, 2) float32 on the CPU.
        plane: (features, height, width) float32 on the CPU.
        grad: (n, features) float32 on the CPU.

    Returns:
        (n, 2) float32; bit-identical for every thread count.
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
