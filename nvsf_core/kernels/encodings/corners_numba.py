"""Grid points around a block of positions, and their linear weights, in loops that compilers vectorise.

For that they take one axis at a time, in float32 and 32-bit integers, with unsigned indices (numba tests
signed ones for being negative). No fast-math flag is set: with a fused multiply-add a point on a cell border
could get another cell than in the torch oracle. numba passes a caller's flags on to the functions it calls.
"""

from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from torch import Tensor

BLOCK = 256
"""Points a block: all their corners are computed before the rows are read, so that reads of many points
overlap. Its 28 KiB of scratch memory fit into the first-level cache."""

AHEAD = 32
"""Rows are prefetched this many points before they are needed; processors by themselves look seven ahead."""


@numba.njit(error_model="numpy")  # type: ignore[untyped-decorator,unused-ignore]
def corner_scratch(corners: Any) -> Any:
    """Scratch memory of `place_corners`: keys and shares of three axes, entries and weights of the corners.

    Keys and shares have two rows of BLOCK an axis, for its lower and upper points; an absent axis has neutral
    ones. The prefetch reads the entries up to AHEAD points past the last.
    """
    return (
        np.zeros(6 * BLOCK, np.uint32),
        np.ones(6 * BLOCK, np.float32),
        np.empty(corners * BLOCK + 2 * AHEAD, np.uint32),
        np.empty(corners * BLOCK, np.float32),
    )


# Wide: numba inlines it; each parameter is a scalar or a flat array of the caller's loop.
@numba.njit(error_model="numpy")  # type: ignore[untyped-decorator,unused-ignore]
def place_corners(
    axes: Any, points: Any, first: Any, count: Any, scales: Any, shift: Any, lasts: Any, factors: Any,
    dense: Any, mask: Any, scratch: Any,
) -> Any:  # fmt: skip
    """Table entries and linear weights of the corners of a block of positions, two or three axes each.

    A coordinate x, clamped to [0, 1], is at ``x * scale + shift`` of the grid. NaN reads point 0; its weights
    are NaN. Entries and weights have a row of 2 * BLOCK for each pair of corners that are neighbours in x (y
    varies fastest); in it the lower and the upper corner of a position are side by side.

    Args:
        axes: Flat float32 coordinates, see `axis_by_axis`.
        points: Number of all positions.
        first: Index of the block's first position.
        count: Number of its positions, at most BLOCK.
        scales: Of each axis float32, its cells.
        shift: Float32, position of x = 0.
        lasts: Of each axis uint32, its largest grid point.
        factors: Of each axis uint32, by which grid points are multiplied in the keys.
        dense: True = an entry is the sum of keys, False = their XOR, masked.
        mask: Uint32, entries of a hashed level minus 1.
        scratch: From `corner_scratch`, written.
    """
    key, share, entry, weight = scratch
    zero, one = np.float32(0.0), np.float32(1.0)
    for axis in range(factors.size):
        scale, last, factor = scales[axis], lasts[axis], factors[axis]
        begin = np.uint64(axis * points + first)
        low, high = np.uint64(2 * axis * BLOCK), np.uint64((2 * axis + 1) * BLOCK)
        for k in range(count):
            i = np.uint64(k)
            x = axes[begin + i]
            known = x if x == x else zero
            position = min(max(known, zero), one) * scale + shift
            lower = np.int32(position)
            fraction = position - np.float32(lower)
            fraction = fraction if x == x else x
            share[low + i] = one - fraction
            share[high + i] = fraction
            key[low + i] = np.uint32(np.uint32(lower) * factor)
            key[high + i] = np.uint32(min(np.uint32(lower + np.int32(1)), last) * factor)
    left, right = np.uint64(0), np.uint64(BLOCK)
    for pair in range(1 << (factors.size - 1)):
        y = np.uint64((2 + (pair & 1)) * BLOCK)
        z = np.uint64((4 + (pair >> 1)) * BLOCK)
        to = np.uint64(2 * pair * BLOCK)
        for k in range(count):
            i = np.uint64(k)
            one_side, other = to + np.uint64(2) * i, to + np.uint64(2) * i + np.uint64(1)
            a, b, c, d = key[left + i], key[right + i], key[y + i], key[z + i]
            entry[one_side] = np.uint32(a + c + d) if dense else np.uint32((a ^ c ^ d) & mask)
            entry[other] = np.uint32(b + c + d) if dense else np.uint32((b ^ c ^ d) & mask)
            weight[one_side] = share[left + i] * share[y + i] * share[z + i]
            weight[other] = share[right + i] * share[y + i] * share[z + i]
    return entry, weight


def axis_by_axis(positions: Tensor) -> Any:
    """Positions (n, d) as a flat float32 array (d * n,), axis by axis."""
    # numpy transposes this shape six times faster than torch
    return np.ascontiguousarray(positions.detach().numpy().T).reshape(-1)


def compiled(function: Callable[..., Any]) -> Any:
    """Compile at the first call; cache beside the source or in the user's cache, if either is writable."""
    options: dict[str, Any] = {"parallel": True, "nogil": True, "error_model": "numpy"}
    try:
        return numba.njit(function, cache=True, **options)
    except RuntimeError:
        return numba.njit(function, **options)
