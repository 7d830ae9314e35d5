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
# Points whose corners are worked out (vectorised) before their entries are fetched: fetches of many points
# then overlap in flight, and the scratch of 32 KiB stays in the first cache.
_BLOCK = 512
# A level is walked over this many points before the next, so that its part of the table stays mapped.
_FORWARD_CHUNK = 65536
_OPTIONS: dict[str, Any] = {"parallel": True, "nogil": True, "error_model": "numpy"}


def _compiled(function: Callable[..., Any], **options: Any) -> Any:
    """Compile lazily; cache beside the source or in the user's cache, nowhere if neither is writable."""
    try:
        return numba.njit(function, cache=True, **options)
    except RuntimeError:
        return numba.njit(function, **options)


@numba.njit(error_model="numpy")  # type: ignore[untyped-decorator,unused-ignore]
def _cell(x: Any, scale: Any) -> Any:
    """Lower grid point and fraction along an axis; NaN reads cell 0 and stays NaN in the fraction."""
    known = x if x == x else np.float32(0.0)
    position = min(max(known, np.float32(0.0)), np.float32(1.0)) * scale + np.float32(0.5)
    lower = np.int64(position)
    return lower, (position - np.float32(lower) if x == x else x)


@numba.njit(error_model="numpy")  # type: ignore[untyped-decorator,unused-ignore]
def _corners(
    positions: Any, first: Any, count: Any, scale: Any, resolution: Any, dense: Any, mask: Any,
    entry: Any, weight: Any,
) -> None:  # fmt: skip
    """Entries (within the level) and trilinear weights of the eight grid points around each position.

    Fills entry and weight (8, block) for `count` positions from `first` on; x varies fastest.
    """
    one = np.float32(1.0)
    top = resolution - 1
    for i in range(count):
        x, fx = _cell(positions[first + i, 0], scale)
        y, fy = _cell(positions[first + i, 1], scale)
        z, fz = _cell(positions[first + i, 2], scale)
        gx, gy, gz = one - fx, one - fy, one - fz
        gygz, fygz, gyfz, fyfz = gy * gz, fy * gz, gy * fz, fy * fz
        weight[0, i], weight[1, i], weight[2, i], weight[3, i] = gx * gygz, fx * gygz, gx * fygz, fx * fygz
        weight[4, i], weight[5, i], weight[6, i], weight[7, i] = gx * gyfz, fx * gyfz, gx * fyfz, fx * fyfz
        if dense:
            x0, x1 = min(x, top), min(x + 1, top)
            y0, y1 = min(y, top) * resolution, min(y + 1, top) * resolution
            z0 = min(z, top) * resolution * resolution
            z1 = min(z + 1, top) * resolution * resolution
            entry[0, i], entry[1, i] = x0 + y0 + z0, x1 + y0 + z0
            entry[2, i], entry[3, i] = x0 + y1 + z0, x1 + y1 + z0
            entry[4, i], entry[5, i] = x0 + y0 + z1, x1 + y0 + z1
            entry[6, i], entry[7, i] = x0 + y1 + z1, x1 + y1 + z1
        else:
            x1 = x + 1
            y0, z0 = y * _PRIME_Y, z * _PRIME_Z
            y1, z1 = y0 + _PRIME_Y, z0 + _PRIME_Z
            entry[0, i], entry[1, i] = (x ^ y0 ^ z0) & mask, (x1 ^ y0 ^ z0) & mask
            entry[2, i], entry[3, i] = (x ^ y1 ^ z0) & mask, (x1 ^ y1 ^ z0) & mask
            entry[4, i], entry[5, i] = (x ^ y0 ^ z1) & mask, (x1 ^ y0 ^ z1) & mask
            entry[6, i], entry[7, i] = (x ^ y1 ^ z1) & mask, (x1 ^ y1 ^ z1) & mask


@numba.njit(error_model="numpy")  # type: ignore[untyped-decorator,unused-ignore]
def _corners_of_square(
    positions: Any, first: Any, count: Any, scale: Any, resolution: Any, dense: Any, mask: Any,
    entry: Any, weight: Any,
) -> None:  # fmt: skip
    """As `_corners`, in two dimensions: fills the first four rows."""
    one = np.float32(1.0)
    top = resolution - 1
    for i in range(count):
        x, fx = _cell(positions[first + i, 0], scale)
        y, fy = _cell(positions[first + i, 1], scale)
        gx, gy = one - fx, one - fy
        weight[0, i], weight[1, i], weight[2, i], weight[3, i] = gx * gy, fx * gy, gx * fy, fx * fy
        if dense:
            x0, x1 = min(x, top), min(x + 1, top)
            y0, y1 = min(y, top) * resolution, min(y + 1, top) * resolution
            entry[0, i], entry[1, i], entry[2, i], entry[3, i] = x0 + y0, x1 + y0, x0 + y1, x1 + y1
        else:
            y0 = y * _PRIME_Y
            y1 = y0 + _PRIME_Y
            entry[0, i], entry[1, i] = (x ^ y0) & mask, ((x + 1) ^ y0) & mask
            entry[2, i], entry[3, i] = (x ^ y1) & mask, ((x + 1) ^ y1) & mask


@cache
def _forward_for(feature_count: int, corners: int) -> Any:
    """The forward kernel with the number of features known to the compiler, which unrolls over them."""
    # unsigned: numba would test every signed index for being negative
    features = np.uint64(feature_count)

    def forward(
        positions: Any, table: Any, scales: Any, resolutions: Any, dense: Any, offsets: Any, mask: Any,
        chunk_points: Any, out: Any,
    ) -> None:  # fmt: skip
        points = positions.shape[0]
        levels = scales.shape[0]
        for chunk in prange((points + chunk_points - 1) // chunk_points):
            entry = np.empty((8, _BLOCK), np.uint32)
            weight = np.empty((8, _BLOCK), np.float32)
            end = min((chunk + 1) * chunk_points, points)
            for level in range(levels):
                part = table[offsets[level] * features : offsets[level + 1] * features]
                for first in range(chunk * chunk_points, end, _BLOCK):
                    count = min(_BLOCK, end - first)
                    if corners == 8:
                        _corners(
                            positions, first, count, scales[level], resolutions[level], dense[level], mask,
                            entry, weight,
                        )  # fmt: skip
                    else:
                        _corners_of_square(
                            positions, first, count, scales[level], resolutions[level], dense[level], mask,
                            entry, weight,
                        )  # fmt: skip
                    for i in range(count):
                        row = np.uint64((first + i) * levels + level) * features
                        for f in range(features):
                            k = np.uint64(f)
                            total = np.float32(0.0)
                            for corner in range(corners):
                                total += weight[corner, i] * part[np.uint64(entry[corner, i]) * features + k]
                            out[row + k] = total

    return _compiled(forward, **_OPTIONS)


@cache
def _adjoint_for(feature_count: int, corners: int) -> Any:
    """The adjoint kernel with the number of features known to the compiler."""
    features = np.uint64(feature_count)

    def adjoint(
        positions: Any, grad: Any, scales: Any, resolutions: Any, dense: Any, offsets: Any, mask: Any,
        workers: Any, grad_table: Any,
    ) -> None:  # fmt: skip
        points = positions.shape[0]
        levels = scales.shape[0]
        # A worker owns every workers-th level, so no two ever write the same entry.
        for worker in prange(workers):
            entry = np.empty((8, _BLOCK), np.uint32)
            weight = np.empty((8, _BLOCK), np.float32)
            for level in range(worker, levels, workers):
                part = grad_table[offsets[level] * features : offsets[level + 1] * features]
                for first in range(0, points, _BLOCK):
                    count = min(_BLOCK, points - first)
                    if corners == 8:
                        _corners(
                            positions, first, count, scales[level], resolutions[level], dense[level], mask,
                            entry, weight,
                        )  # fmt: skip
                    else:
                        _corners_of_square(
                            positions, first, count, scales[level], resolutions[level], dense[level], mask,
                            entry, weight,
                        )  # fmt: skip
                    for i in range(count):
                        row = np.uint64((first + i) * levels + level) * features
                        for corner in range(corners):
                            target = np.uint64(entry[corner, i]) * features
                            corner_weight = weight[corner, i]
                            for f in range(features):
                                k = np.uint64(f)
                                part[target + k] += corner_weight * grad[row + k]

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
    """Encode float32 CPU positions (n, dimensions) with a float32 table; no gradient is recorded.

    See `nvsf_core.kernels.hash_grid_encode` for the contract.
    """
    threads = _use_threads_of_torch()
    points = positions.shape[0]
    out = np.empty((points, layout.outputs), dtype=np.float32)
    _forward_for(layout.features, layout.corners)(
        positions.detach().contiguous().numpy(),
        table.detach().contiguous().view(-1).numpy(),
        *_level_arrays(layout),
        max(1, min(_FORWARD_CHUNK, -(-points // threads))),
        out.reshape(-1),
    )
    return torch.from_numpy(out)


def adjoint(positions: Tensor, grad: Tensor, layout: GridLayout) -> Tensor:
    """Gradient with respect to the table, from the gradient with respect to the encoding.

    Args:
        positions: (n, dimensions) float32 on the CPU.
        grad: (n, levels * features) float32 on the CPU.
        layout: the grid.

    Returns:
        (layout.entries, layout.features) float32; the same bits for every thread count.
    """
    threads = _use_threads_of_torch()
    # numpy, unlike torch, asks for huge pages: clearing tens of MB costs a quarter
    grad_table = np.zeros((layout.entries, layout.features), dtype=np.float32)
    _adjoint_for(layout.features, layout.corners)(
        positions.detach().contiguous().numpy(),
        grad.detach().contiguous().view(-1).numpy(),
        *_level_arrays(layout),
        min(threads, layout.levels),
        grad_table.reshape(-1),
    )
    return torch.from_numpy(grad_table)
