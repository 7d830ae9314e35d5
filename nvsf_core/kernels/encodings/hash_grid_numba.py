"""The hash-grid encoding and its table gradient on the CPU, compiled by numba at first use and cached.

Results are bit-identical for every thread count and run: the forward pass is parallel over chunks of points;
the adjoint is parallel over levels, never over points, and adds a level's points in their order. Both passes
compute the corners: that takes a tenth of the time, while storing them would move 64 bytes a point and level.
"""

from functools import cache
from typing import Any

import numba
import numpy as np
import torch
from numba import prange
from torch import Tensor

from nvsf_core.kernels.encodings import oracles_torch
from nvsf_core.kernels.encodings.corners_numba import (
    BLOCK,
    axis_by_axis,
    compiled,
    corner_scratch,
    place_corners,
)
from nvsf_core.kernels.encodings.hash_grid import PRIMES, GridLayout
from nvsf_core.kernels.encodings.rows_numba import copy_row, gather, scatter

# Points that one level is computed for before the next, so that the level's part of the table stays cached;
# few enough for their rows of all levels to stay in the second-level cache until they are reordered.
_FORWARD_CHUNK = 4096
_HALF = np.float32(0.5)


@cache
def _forward_for(features: int, dimensions: int) -> Any:
    """The forward kernel with features and dimensions known to the compiler."""
    corners = 1 << dimensions

    def forward(
        axes: Any, table: Any, scales: Any, lasts: Any, factors: Any, dense: Any, offsets: Any, mask: Any,
        points: Any, chunk_points: Any, out: Any,
    ) -> None:  # fmt: skip
        # Read from an array: constants would be unrolled, and compiling would take twice as long.
        levels = factors.shape[0]
        for chunk in prange((points + chunk_points - 1) // chunk_points):
            scratch = corner_scratch(8)
            begin = chunk * chunk_points
            end = min(begin + chunk_points, points)
            rows = np.empty(levels * chunk_points * features, np.float32)
            for level in range(levels):
                part = table[offsets[level] * features : offsets[level + 1] * features]
                for first in range(begin, end, BLOCK):
                    count = min(BLOCK, end - first)
                    entry, weight = place_corners(
                        axes, points, first, count, scales[level], _HALF, lasts[level], factors[level],
                        dense[level], mask, scratch,
                    )  # fmt: skip
                    for i in range(count):
                        start = (level * chunk_points + first - begin + i) * features
                        gather(part, entry, weight, i, rows, start, corners, BLOCK, features, features)
            for first in range(begin, end, BLOCK):
                for level in range(levels):
                    for point in range(first, min(first + BLOCK, end)):
                        start = (level * chunk_points + point - begin) * features
                        copy_row(rows, start, out, (point * levels + level) * features, features)

    return compiled(forward)


@cache
def _adjoint_for(features: int, dimensions: int) -> Any:
    """The adjoint kernel with features and dimensions known to the compiler."""
    corners = 1 << dimensions

    def adjoint(
        axes: Any, grad: Any, scales: Any, lasts: Any, factors: Any, dense: Any, offsets: Any, mask: Any,
        points: Any, workers: Any, grad_table: Any,
    ) -> None:  # fmt: skip
        # Read from an array: constants would be unrolled, and compiling would take twice as long.
        levels = factors.shape[0]
        rows = np.empty(levels * points * features, np.float32)
        for block in prange((points + BLOCK - 1) // BLOCK):
            for level in range(levels):
                for point in range(block * BLOCK, min((block + 1) * BLOCK, points)):
                    start = (level * points + point) * features
                    copy_row(grad, (point * levels + level) * features, rows, start, features)
        # Each worker has whole levels, so no two write the same entry. Levels are assigned forwards, then
        # backwards, because finer ones take longer (more cache misses).
        for worker in prange(workers):
            scratch = corner_scratch(8)
            for level in range(levels):
                turn = level % (2 * workers)
                if min(turn, 2 * workers - 1 - turn) != worker:
                    continue
                part = grad_table[offsets[level] * features : offsets[level + 1] * features]
                for first in range(0, points, BLOCK):
                    count = min(BLOCK, points - first)
                    entry, weight = place_corners(
                        axes, points, first, count, scales[level], _HALF, lasts[level], factors[level],
                        dense[level], mask, scratch,
                    )  # fmt: skip
                    for i in range(count):
                        start = (level * points + first + i) * features
                        scatter(part, entry, weight, i, rows, start, corners, BLOCK, features, features)

    return compiled(adjoint)


@cache
def _level_arrays(layout: GridLayout) -> tuple[Any, ...]:
    """Scale, last grid point and factor by level and axis; whether dense and offset by level; the hash mask.

    A lower grid point is never past the last: floor(scale + 0.5) <= ceil(scale). Hashed levels have no last.
    """
    sizes = tuple(zip(layout.resolutions, layout.is_dense, strict=True))
    factors = [(1, size, size * size) if dense else PRIMES for size, dense in sizes]
    axes, lasts = layout.dimensions, [size - 1 if dense else 0xFFFFFFFF for size, dense in sizes]
    return (
        np.array([layout.scales] * axes, dtype=np.float32).T.copy(),
        np.array([lasts] * axes, dtype=np.uint32).T.copy(),
        np.array(factors, dtype=np.uint32)[:, :axes].copy(),
        np.array(layout.is_dense, dtype=np.bool_),
        np.array(layout.offsets, dtype=np.int64),
        np.uint32(layout.table_entries - 1),
    )


def encode(positions: Tensor, table: Tensor, layout: GridLayout) -> Tensor:
    """Encode float32 CPU positions (n, dimensions) with a float32 table, without autograd.

    Arguments and result as in `hash_grid.hash_grid_encode`.
    """
    points = positions.shape[0]
    blocks_a_thread = -(-points // (BLOCK * numba.get_num_threads()))
    out = np.empty((points, layout.outputs), dtype=np.float32)
    _forward_for(layout.features, layout.dimensions)(
        axis_by_axis(positions),
        table.detach().contiguous().view(-1).numpy(),
        *_level_arrays(layout),
        points,
        max(1, min(_FORWARD_CHUNK // BLOCK, blocks_a_thread)) * BLOCK,
        out.reshape(-1),
    )
    return torch.from_numpy(out)


def adjoint(positions: Tensor, grad: Tensor, layout: GridLayout) -> Tensor:
    """Gradient of the table (layout.entries, layout.features), bit-identical for every thread count.

    From float32 positions (n, dimensions) and the gradient (n, levels * features) float32 of the encoding, on
    the CPU.
    """
    # numpy, unlike torch, requests huge pages: clearing tens of MB takes a quarter of the time
    grad_table = np.zeros((layout.entries, layout.features), dtype=np.float32)
    _adjoint_for(layout.features, layout.dimensions)(
        axis_by_axis(positions),
        grad.detach().contiguous().view(-1).numpy(),
        *_level_arrays(layout),
        positions.shape[0],
        min(numba.get_num_threads(), layout.levels),
        grad_table.reshape(-1),
    )
    return torch.from_numpy(grad_table)


def position_adjoint(positions: Tensor, table: Tensor, grad: Tensor, layout: GridLayout) -> Tensor:
    """Gradient (n, dimensions) of the positions, by the torch oracle; arguments as in `hash_grid_triton`."""
    with torch.enable_grad():
        moved = positions.detach().requires_grad_()
        encoded = oracles_torch.encode(moved, table.detach(), layout)
        return torch.autograd.grad(encoded, moved, grad)[0]
