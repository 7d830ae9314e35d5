"""Single pixels of a depth map whose depth is another than that of most around them, in numba."""

import numpy as np
from numba import njit

_REACH = 2
"""Windows have so many pixels on each side of their own."""
_SHARE, _PER_M = np.float32(0.05), np.float32(5e-4)
"""Inverse depths are of one surface if they differ by at most this share of the larger, plus so much, 1/m."""


def without_speckles(inverse: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Inverse depths (h, w), 1/m; of a pixel unlike most around it, the median of those around it.

    Leaves in front of something far, and edges where maps disagree, leave such pixels in a view's depth.

    Args:
        inverse: (h, w) float32, 1/m.
        label: (h, w) uint8: what pixels show; only those that show the same are compared.
    """
    found = inverse.copy()
    _replace(inverse, label, found)
    return found


@njit(cache=True, nogil=True)
def _replace(inverse, label, found):  # type: ignore[no-untyped-def]
    rows, columns = inverse.shape
    around = np.empty((2 * _REACH + 1) ** 2, np.float32)
    for r in range(rows):
        for c in range(columns):
            own, count, unlike = inverse[r, c], 0, 0
            for i in range(max(r - _REACH, 0), min(r + _REACH + 1, rows)):
                for j in range(max(c - _REACH, 0), min(c + _REACH + 1, columns)):
                    if label[i, j] == label[r, c]:
                        around[count] = inverse[i, j]
                        unlike += _differ(around[count], own)
                        count += 1
            if 2 * unlike > count:
                median = np.median(around[:count])
                if _differ(np.float32(median), own):
                    found[r, c] = median


@njit(inline="always")
def _differ(one, other):  # type: ignore[no-untyped-def]
    return abs(one - other) > _SHARE * max(one, other) + _PER_M
