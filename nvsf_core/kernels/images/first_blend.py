"""A blend of source images by their weights alone, to which each of them can be compared, in numba."""

from typing import NamedTuple

import numpy as np
from numba import njit

_AROUND = np.float32(0.05)
"""Weight of the colour around a hole, where the nearest source has 1."""
_LUMA = (np.float32(0.299), np.float32(0.587), np.float32(0.114))
_ZERO = np.float32(0.0)


class FirstBlend(NamedTuple):
    """What k sources show at each pixel's likeliest depth."""

    colour: np.ndarray
    """(3, h, w) float32 mean of all of them, 0..1."""
    shown: np.ndarray
    """(k, 3, h, w) float32 of each of them; 0 where it does not show the point."""
    is_shown: np.ndarray
    """(k, h, w) bool, whether it does."""


def first_blend(
    colour: np.ndarray, seen: np.ndarray, likeliest: np.ndarray, around: np.ndarray, weight: np.ndarray
) -> FirstBlend:
    """The mean of what sources show at the likeliest depths, by their weights.

    Args:
        colour: (k, 3, d, h, w) float32 that the sources show at d depths, 0..1.
        seen: (k, d, h, w) bool, whether they do.
        likeliest: (h, w) int64, which of the d depths is the likeliest.
        around: (3, h, w) float32 colours where no source shows anything.
        weight: (k,) float32 of the sources; 1 = of the nearest.
    """
    shown = np.empty((len(colour), 3, *around.shape[1:]), np.float32)
    is_shown = np.empty((len(colour), *around.shape[1:]), np.bool_)
    _take(colour, seen, likeliest, shown, is_shown)
    share = weight[:, None, None] * is_shown
    mean = (_AROUND * around + (share[:, None] * shown).sum(axis=0)) / (_AROUND + share.sum(axis=0))
    return FirstBlend(mean, shown, is_shown)


def luma(colour: np.ndarray) -> np.ndarray:
    """Brightness (h, w) of colours (3, h, w)."""
    red, green, blue = _LUMA
    return red * colour[0] + green * colour[1] + blue * colour[2]


@njit(cache=True, nogil=True)
def _take(colour, seen, likeliest, shown, is_shown):  # type: ignore[no-untyped-def]
    """Write the colours (k, 3, h, w) at the likeliest depths, and whether sources show them (k, h, w)."""
    count, rows, columns = is_shown.shape
    for k in range(count):
        for r in range(rows):
            for c in range(columns):
                d = likeliest[r, c]
                is_shown[k, r, c] = seen[k, d, r, c]
                for i in range(3):
                    shown[k, i, r, c] = colour[k, i, d, r, c] if seen[k, d, r, c] else _ZERO
