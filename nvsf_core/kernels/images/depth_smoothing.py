"""A view's depth without single pixels of another depth, and without the noise of its surfaces, in numba."""

import numpy as np
from numba import njit

_REACH = 2
"""Windows have so many pixels on each side of their own."""
_SHARE, _PER_M = np.float32(0.05), np.float32(5e-4)
"""Inverse depths are of one surface if they differ by at most this share of the larger, plus so much, 1/m."""
_ONE, _TWO = np.float32(1.0), np.float32(2.0)


def smoothed(inverse: np.ndarray, label: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A depth that is smooth where it is of one surface; edges stay.

    A pixel unlike most around it takes the median of those around it: leaves in front of something far, and
    edges where maps disagree, leave such pixels in a view's depth. Any other takes the mean of itself and all
    pairs of opposite pixels around it that are both of its surface: the inverse depth of a plane is linear in
    column and row, so that this mean is exact, however slanted the plane.

    Args:
        inverse: (h, w) float32, 1/m.
        label: (h, w) uint8: what pixels show; only those that show the same are compared.

    Returns:
        (h, w) float32, 1/m, and where it is a median of what is around, (h, w) bool.
    """
    found, is_other = np.empty_like(inverse), np.empty(inverse.shape, np.bool_)
    _smooth(inverse, label, found, is_other)
    return found, is_other


@njit(cache=True, nogil=True)
def _smooth(inverse, label, found, is_other):  # type: ignore[no-untyped-def]
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
            median = np.float32(np.median(around[:count])) if 2 * unlike > count else own
            is_other[r, c] = _differ(median, own)
            found[r, c] = median if is_other[r, c] else _mean_of_pairs(inverse, label, r, c)


@njit(inline="always")
def _mean_of_pairs(inverse, label, r, c):  # type: ignore[no-untyped-def]
    """Mean of a pixel and of all pairs of opposite pixels around it that are of its surface."""
    reach_r = min(_REACH, r, inverse.shape[0] - 1 - r)
    reach_c = min(_REACH, c, inverse.shape[1] - 1 - c)
    own, total, count = inverse[r, c], inverse[r, c], _ONE
    for i in range(reach_r + 1):
        # Each pair once: of the row itself the pixels to the right only.
        for j in range(-reach_c if i > 0 else 1, reach_c + 1):
            one, other = inverse[r + i, c + j], inverse[r - i, c - j]
            is_shown = label[r + i, c + j] == label[r, c] and label[r - i, c - j] == label[r, c]
            if is_shown and not _differ(one, own) and not _differ(other, own):
                total += one + other
                count += _TWO
    return total / count


@njit(inline="always")
def _differ(one, other):  # type: ignore[no-untyped-def]
    return abs(one - other) > _SHARE * max(one, other) + _PER_M
