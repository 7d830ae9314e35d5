"""Grid points around a block of positions, and their linear weights, in loops that compilers vectorise.

For that they take one axis at a time, in float32 and 32-bit integers, with unsigned indices (numba tests
signed ones for being negative). No fast-math flag is set: with a fused multiply-add a point on a cell border
could get another cell than in the torch oracle. numba passes a caller's flags on to the functions it calls.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from torch import Tensor

__all__ = [
    "AHEAD", "BLOCK", "axis_by_axis", "combine", "compiled", "corner_scratch", "neutral_axes", "place",
]  # fmt: skip

BLOCK = 256
"""Points a block: all their corners are computed before the rows are read, so that reads of many points
overlap. Its 28 KiB of scratch memory fit into the first-level cache."""

AHEAD = 32
"""Rows are prefetched this many points before they are needed; processors by themselves look seven ahead."""


@numba.njit(error_model="numpy")  # type: ignore[untyped-decorator,unused-ignore]
def neutral_axes() -> Any:
    """Scratch memory of `place`: keys and shares (6 * BLOCK,), for three axes their lower and upper points.

    An axis that `place` is not called for has key 0 and share 1, which are neutral in `combine`.
    """
    return np.zeros(6 * BLOCK, np.uint32), np.ones(6 * BLOCK, np.float32)


@numba.njit(error_model="numpy")  # type: ignore[untyped-decorator,unused-ignore]
def corner_scratch(corners: Any) -> Any:
    """Scratch memory of `combine`: entries and weights of a block's corners.

    The prefetch reads the entries up to AHEAD points past the last.
    """
    return np.empty(corners * BLOCK + 2 * AHEAD, np.uint32), np.empty(corners * BLOCK, np.float32)


# Wide: numba inlines it; each parameter is a scalar or a flat array of the caller's loop.
@numba.njit(error_model="numpy")  # type: ignore[untyped-decorator,unused-ignore]
def place(
    coordinates: Any, first: Any, count: Any, axis: Any, scale: Any, shift: Any, last: Any, factor: Any,
    key: Any, share: Any,
) -> None:  # fmt: skip
    """Lower and upper grid point of each coordinate along one axis, and their linear weights (shares).

    A coordinate x, clamped to [0, 1], is at ``x * scale + shift``. NaN reads point 0; its shares are NaN.

    Args:
        coordinates: Flat float32, see `axis_by_axis`.
        first: Index of the first coordinate.
        count: Number of coordinates, at most BLOCK.
        axis: 0, 1 or 2.
        scale: Float32, cells along the axis.
        shift: Float32, position of x = 0.
        last: Uint32, largest grid point.
        factor: Uint32, by which grid points are multiplied in the keys.
        key: Written: the axis' two rows of BLOCK keys, grid point times factor.
        share: Written: the axis' two rows of BLOCK shares, 1 - fraction and fraction.
    """
    zero, one = np.float32(0.0), np.float32(1.0)
    begin = np.uint64(first)
    low = np.uint64(2 * axis * BLOCK)
    high = np.uint64((2 * axis + 1) * BLOCK)
    for k in range(count):
        i = np.uint64(k)
        x = coordinates[begin + i]
        known = x if x == x else zero
        position = min(max(known, zero), one) * scale + shift
        lower = np.int32(position)
        fraction = position - np.float32(lower)
        fraction = fraction if x == x else x
        share[low + i] = one - fraction
        share[high + i] = fraction
        key[low + i] = np.uint32(np.uint32(lower) * factor)
        key[high + i] = np.uint32(min(np.uint32(lower + np.int32(1)), last) * factor)


# Wide: numba inlines it; each parameter is a scalar or a flat array of the caller's loop.
@numba.njit(error_model="numpy")  # type: ignore[untyped-decorator,unused-ignore]
def combine(
    key: Any, share: Any, count: Any, axes: Any, dense: Any, mask: Any, entry: Any, weight: Any
) -> None:  # fmt: skip
    """Table entries and weights of the 2^axes corners of each position.

    Results have a row of 2 * BLOCK for each pair of corners that are neighbours in x (y varies fastest); in
    it the lower and the upper corner of a position are side by side.

    Args:
        key: Keys from `place`.
        share: Shares from `place`.
        count: Number of positions, at most BLOCK.
        axes: Number of axes, 2 or 3.
        dense: True = an entry is the sum of keys, False = their XOR, masked.
        mask: Uint32, entries of a hashed level minus 1.
        entry: Written: uint32 entries.
        weight: Written: float32 products of shares.
    """
    lower, upper = np.uint64(0), np.uint64(BLOCK)
    for pair in range(1 << (axes - 1)):
        y = np.uint64((2 + (pair & 1)) * BLOCK)
        z = np.uint64((4 + (pair >> 1)) * BLOCK)
        to = np.uint64(2 * pair * BLOCK)
        for k in range(count):
            i = np.uint64(k)
            first, second = to + np.uint64(2) * i, to + np.uint64(2) * i + np.uint64(1)
            a, b, c, d = key[lower + i], key[upper + i], key[y + i], key[z + i]
            entry[first] = np.uint32(a + c + d) if dense else np.uint32((a ^ c ^ d) & mask)
            entry[second] = np.uint32(b + c + d) if dense else np.uint32((b ^ c ^ d) & mask)
            weight[first] = share[lower + i] * share[y + i] * share[z + i]
            weight[second] = share[upper + i] * share[y + i] * share[z + i]


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
