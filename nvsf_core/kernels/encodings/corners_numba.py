"""Grid points around a block of positions and their linear weights, in loops that the compiler vectorises.

What the loops need for that: one axis after the other in float32 and 32-bit integers, unsigned indices
(numba would test a signed one for being negative). No fast-math flag is set: a fused multiply-add would put
a point on a cell border into another cell than the oracle's, and numba hands a caller's flags down to what
it calls.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

__all__ = [
    "AHEAD", "BLOCK", "axis_by_axis", "combine", "compiled", "corner_scratch", "neutral_axes", "place",
    "use_threads_of_torch",
]  # fmt: skip

BLOCK = 256
"""Points whose corners are worked out before their rows are fetched: fetches of many points overlap in
flight, and the scratch of 28 KiB stays in the first cache."""

AHEAD = 32
"""Rows are asked for this many points before they are needed; the processor by itself looks seven ahead."""


@numba.njit(error_model="numpy")  # type: ignore[untyped-decorator,unused-ignore]
def neutral_axes() -> Any:
    """Scratch of `place`: two rows (lower and upper point) for each of three axes, keys and shares.

    An axis that is never placed has key 0 and share 1, which change nothing in `combine`.
    """
    return np.zeros(6 * BLOCK, np.uint32), np.ones(6 * BLOCK, np.float32)


@numba.njit(error_model="numpy")  # type: ignore[untyped-decorator,unused-ignore]
def corner_scratch(corners: Any) -> Any:
    """Scratch of `combine`: entries and weights of a block's corners.

    What is asked for ahead is read from the entries too, AHEAD points past the last.
    """
    return np.empty(corners * BLOCK + 2 * AHEAD, np.uint32), np.empty(corners * BLOCK, np.float32)


@numba.njit(error_model="numpy")  # type: ignore[untyped-decorator,unused-ignore]
def place(
    coordinates: Any, first: Any, count: Any, axis: Any, scale: Any, shift: Any, last: Any, factor: Any,
    key: Any, share: Any,
) -> None:  # fmt: skip
    """Lower and upper grid point along an axis of `count` coordinates from `first` on, at most BLOCK.

    A coordinate x, clamped to [0, 1], lies at ``x * scale + shift``. The keys are the two points (at most
    `last`) times `factor`, the shares 1 - fraction and fraction. NaN reads point 0; its shares are NaN.
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


@numba.njit(error_model="numpy")  # type: ignore[untyped-decorator,unused-ignore]
def combine(
    key: Any, share: Any, count: Any, axes: Any, dense: Any, mask: Any, entry: Any, weight: Any
) -> None:  # fmt: skip
    """Entries and weights of the corners: sums of keys where dense, else their masked XOR; share products.

    Fills entry (uint32) and weight (float32) of 2^axes corners: for each pair of neighbours in x, y varying
    fastest, one row of 2 * BLOCK, in which the lower and the upper point of a position lie side by side.
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
    """Positions (n, d) as a flat float32 array (d * n,), one axis after the other."""
    # numpy transposes this shape six times faster than torch
    return np.ascontiguousarray(positions.detach().numpy().T).reshape(-1)


def compiled(function: Callable[..., Any]) -> Any:
    """Compile lazily; cache beside the source or in the user's cache, nowhere if neither is writable."""
    options: dict[str, Any] = {"parallel": True, "nogil": True, "error_model": "numpy"}
    try:
        return numba.njit(function, cache=True, **options)
    except RuntimeError:
        return numba.njit(function, **options)


def use_threads_of_torch() -> int:
    """One thread count for torch and numba, so that a run's thread count is set in one place."""
    threads = int(min(torch.get_num_threads(), numba.config.NUMBA_NUM_THREADS))
    numba.set_num_threads(threads)
    return threads
