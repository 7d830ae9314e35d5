"""The hash-grid encode and its adjoint for the CPU, compiled by numba on first use and cached on disk.

Bits: the forward pass is parallel over chunks of points that do not touch; the adjoint is parallel over
levels, never over points, and each level adds its points in their order. So neither the thread count nor
the run changes a bit. No fast-math flag is set: a fused multiply-add would put a point on a cell border into
another cell than the oracle's, and numba hands a caller's flags down to what it calls.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numba
import numpy as np
import torch
from numba import prange
from torch import Tensor

from nvsf_core.kernels.layout import PRIMES, GridLayout

__all__ = ["adjoint", "encode"]

_PRIME_Y = PRIMES[1]
_PRIME_Z = PRIMES[2]
_FORWARD_CHUNK = 512
_ADJOINT_CHUNK = 2048


def _compiled(function: Callable[..., Any], **options: Any) -> Any:
    """Compile lazily and cache beside the source, or in the user's cache; without one where none is writable."""
    try:
        return numba.njit(function, cache=True, **options)
    except RuntimeError:
        return numba.njit(function, **options)


@numba.njit(error_model="numpy")
def _cell(x: Any, scale: Any) -> Any:
    """Lower grid point and fraction along an axis; NaN reads cell 0 and stays NaN in the fraction."""
    position = min(max(x, np.float32(0.0)), np.float32(1.0)) * scale + np.float32(0.5)
    if x != x:
        return np.int64(0), x
    lower = np.int64(position)
    return lower, position - np.float32(lower)


@numba.njit(error_model="numpy")
def _corners(x: Any, y: Any, z: Any, dense: Any, resolution: Any, mask: Any) -> Any:
    """Entries, within the level, of the eight grid points around the cell; x varies fastest."""
    if dense:
        top = resolution - 1
        x0, x1 = min(x, top), min(x + 1, top)
        y0, y1 = min(y, top) * resolution, min(y + 1, top) * resolution
        z0 = min(z, top) * resolution * resolution
        z1 = min(z + 1, top) * resolution * resolution
        return (
            x0 + y0 + z0, x1 + y0 + z0, x0 + y1 + z0, x1 + y1 + z0,
            x0 + y0 + z1, x1 + y0 + z1, x0 + y1 + z1, x1 + y1 + z1,
        )  # fmt: skip
    x1 = x + 1
    y0 = y * _PRIME_Y
    z0 = z * _PRIME_Z
    y1 = y0 + _PRIME_Y
    z1 = z0 + _PRIME_Z
    y0z0, y1z0, y0z1, y1z1 = y0 ^ z0, y1 ^ z0, y0 ^ z1, y1 ^ z1
    return (
        (x ^ y0z0) & mask, (x1 ^ y0z0) & mask, (x ^ y1z0) & mask, (x1 ^ y1z0) & mask,
        (x ^ y0z1) & mask, (x1 ^ y0z1) & mask, (x ^ y1z1) & mask, (x1 ^ y1z1) & mask,
    )  # fmt: skip


@numba.njit(error_model="numpy")
def _corner_weights(fx: Any, fy: Any, fz: Any) -> Any:
    """Trilinear weights of the eight grid points, in the order of `_corners`."""
    one = np.float32(1.0)
    gx, gy, gz = one - fx, one - fy, one - fz
    gygz, fygz, gyfz, fyfz = gy * gz, fy * gz, gy * fz, fy * fz
    return (
        gx * gygz, fx * gygz, gx * fygz, fx * fygz,
        gx * gyfz, fx * gyfz, gx * fyfz, fx * fyfz,
    )  # fmt: skip


_OPTIONS: dict[str, Any] = {"parallel": True, "nogil": True, "error_model": "numpy"}


@cache
def _forward_for(features: int) -> Any:
    """The forward kernel with the number of features known to the compiler, which unrolls over them."""

    def forward(
        positions: Any, table: Any, scales: Any, resolutions: Any, dense: Any, offsets: Any, mask: Any, out: Any
    ) -> None:
        points = positions.shape[0]
        levels = scales.shape[0]
        for chunk in prange((points + _FORWARD_CHUNK - 1) // _FORWARD_CHUNK):
            first = chunk * _FORWARD_CHUNK
            last = min(first + _FORWARD_CHUNK, points)
            for level in range(levels):
                scale, resolution, is_dense = scales[level], resolutions[level], dense[level]
                start = offsets[level]
                for p in range(first, last):
                    x, fx = _cell(positions[p, 0], scale)
                    y, fy = _cell(positions[p, 1], scale)
                    z, fz = _cell(positions[p, 2], scale)
                    w = _corner_weights(fx, fy, fz)
                    e0, e1, e2, e3, e4, e5, e6, e7 = _corners(x, y, z, is_dense, resolution, mask)
                    # unsigned: numba would test each signed index for being negative
                    r0, r1 = np.uint64(start + e0) * features, np.uint64(start + e1) * features
                    r2, r3 = np.uint64(start + e2) * features, np.uint64(start + e3) * features
                    r4, r5 = np.uint64(start + e4) * features, np.uint64(start + e5) * features
                    r6, r7 = np.uint64(start + e6) * features, np.uint64(start + e7) * features
                    row = np.uint64(p * levels + level) * features
                    for f in range(features):
                        k = np.uint64(f)
                        out[row + k] = (
                            (w[0] * table[r0 + k] + w[1] * table[r1 + k])
                            + (w[2] * table[r2 + k] + w[3] * table[r3 + k])
                        ) + (
                            (w[4] * table[r4 + k] + w[5] * table[r5 + k])
                            + (w[6] * table[r6 + k] + w[7] * table[r7 + k])
                        )

    features = np.uint64(features)
    return _compiled(forward, **_OPTIONS)


@cache
def _adjoint_for(features: int) -> Any:
    """The adjoint kernel with the number of features known to the compiler."""

    def adjoint(
        positions: Any, grad: Any, scales: Any, resolutions: Any, dense: Any, offsets: Any, mask: Any,
        workers: Any, grad_table: Any,
    ) -> None:  # fmt: skip
        points = positions.shape[0]
        levels = scales.shape[0]
        # A worker owns every workers-th level, so no two ever write the same entry.
        for worker in prange(workers):
            for first in range(0, points, _ADJOINT_CHUNK):
                last = min(first + _ADJOINT_CHUNK, points)
                for level in range(worker, levels, workers):
                    scale, resolution, is_dense = scales[level], resolutions[level], dense[level]
                    start = offsets[level]
                    for p in range(first, last):
                        x, fx = _cell(positions[p, 0], scale)
                        y, fy = _cell(positions[p, 1], scale)
                        z, fz = _cell(positions[p, 2], scale)
                        w = _corner_weights(fx, fy, fz)
                        e = _corners(x, y, z, is_dense, resolution, mask)
                        row = np.uint64(p * levels + level) * features
                        for corner in range(8):
                            target = np.uint64(start + e[corner]) * features
                            for f in range(features):
                                k = np.uint64(f)
                                grad_table[target + k] += w[corner] * grad[row + k]

    features = np.uint64(features)
    return _compiled(adjoint, **_OPTIONS)


@cache
def _level_arrays(layout: GridLayout) -> tuple[Any, ...]:
    return (
        np.array(layout.scales, dtype=np.float32),
        np.array(layout.resolutions, dtype=np.int64),
        np.array(layout.is_dense, dtype=np.bool_),
        np.array(layout.offsets, dtype=np.int64),
        np.int64(layout.table_entries - 1),
    )


def _use_threads_of_torch() -> int:
    """One thread count for torch and numba, so that a run's thread count is set in one place."""
    threads = int(min(torch.get_num_threads(), numba.config.NUMBA_NUM_THREADS))
    numba.set_num_threads(threads)
    return threads


def encode(positions: Tensor, table: Tensor, layout: GridLayout) -> Tensor:
    """Encode float32 CPU positions (n, 3) with a float32 table; no gradient is recorded.

    See `nvsf_core.kernels.hash_grid_encode` for the contract.
    """
    _use_threads_of_torch()
    out = torch.empty(positions.shape[0], layout.outputs, dtype=torch.float32)
    _forward_for(layout.features)(
        positions.detach().contiguous().numpy(),
        table.detach().contiguous().view(-1).numpy(),
        *_level_arrays(layout),
        out.view(-1).numpy(),
    )
    return out


def adjoint(positions: Tensor, grad: Tensor, layout: GridLayout) -> Tensor:
    """Gradient with respect to the table, from the gradient with respect to the encoding.

    Args:
        positions: (n, 3) float32 on the CPU.
        grad: (n, levels * features) float32 on the CPU.
        layout: the grid.

    Returns:
        (layout.entries, layout.features) float32; the same bits for every thread count.
    """
    threads = _use_threads_of_torch()
    grad_table = torch.zeros(layout.entries, layout.features, dtype=torch.float32)
    _adjoint_for(layout.features)(
        positions.detach().contiguous().numpy(),
        grad.detach().contiguous().view(-1).numpy(),
        *_level_arrays(layout),
        min(threads, layout.levels),
        grad_table.view(-1).numpy(),
    )
    return grad_table
