"""The nearest known pixel of each pixel of an image, and medians along its axes, in numba.

The same as scipy's `distance_transform_edt` and `median_filter`, which take several times as long on images
of half a million pixels; where two known pixels are equally near, either may be meant.
"""

import numpy as np
from numba import njit

_NONE = np.int32(-1)


def nearest_known(known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance (H, W) float32, pixels, and row and column (2, H, W) int32 of each pixel's nearest known one.

    At least one pixel is known (H, W) bool. By the lower envelope of parabolas: along each column first, then
    along each row (Felzenszwalb and Huttenlocher, "Distance transforms of sampled functions", 2012).
    """
    rows = _nearest_in_columns(known)
    gap_px, where = np.empty(known.shape, np.float32), np.empty((2, *known.shape), np.int32)
    _nearest_in_rows(rows, gap_px, where)
    return gap_px, where


@njit(cache=True, nogil=True)
def _nearest_in_columns(known):  # type: ignore[no-untyped-def]
    """(H, W) int32: row of the known pixel that is nearest in the same column; -1 where it has none."""
    height, width = known.shape
    found = np.empty((height, width), np.int32)
    for c in range(width):
        found[0, c] = 0 if known[0, c] else _NONE
    for r in range(1, height):
        for c in range(width):
            found[r, c] = r if known[r, c] else found[r - 1, c]
    for r in range(height - 2, -1, -1):
        for c in range(width):
            above, below = found[r, c], found[r + 1, c]
            if below >= 0 and (above < 0 or below - r < r - above):
                found[r, c] = below
    return found


@njit(cache=True, nogil=True)
def _nearest_in_rows(rows, gap_px, where):  # type: ignore[no-untyped-def]
    """Write distance and place of the nearest known pixel, from those in each column."""
    height, width = rows.shape
    column, start, square = np.empty(width, np.int64), np.empty(width, np.int64), np.empty(width, np.int64)
    for r in range(height):
        count = 0
        for c in range(width):
            if rows[r, c] < 0:
                continue
            square[c] = (rows[r, c] - r) ** 2
            first = 0
            # A parabola is lowest from its `start` to the next one's; one that is lowest nowhere is dropped.
            while count > 0:
                last = column[count - 1]
                first = (c * c - last * last + square[c] - square[last]) // (2 * (c - last)) + 1
                if first > start[count - 1]:
                    break
                count -= 1
            column[count], start[count] = c, first if count > 0 else 0
            count += 1
        k = 0
        for c in range(width):
            while k + 1 < count and start[k + 1] <= c:
                k += 1
            at = column[k]
            gap_px[r, c] = np.sqrt(np.float32((c - at) ** 2 + square[at]))
            where[0, r, c], where[1, r, c] = rows[r, at], at


def median_of_7(image: np.ndarray) -> np.ndarray:
    """Median (H, W) float32 over 7 pixels along each column, then over 7 along each row.

    Beyond its sides the image (H, W) float32, without NaN, is mirrored.
    """
    padded = np.pad(image, ((3, 3), (0, 0)), mode="symmetric")
    along = np.empty_like(image)
    _medians(padded, len(image), along, by_row=True)
    padded = np.pad(along, ((0, 0), (3, 3)), mode="symmetric")
    found = np.empty_like(image)
    _medians(padded, len(image), found, by_row=False)
    return found


@njit(cache=True, nogil=True)
def _medians(padded, height, found, by_row):  # type: ignore[no-untyped-def]
    width = found.shape[1]
    for r in range(height):
        if by_row:
            for c in range(width):
                found[r, c] = _median(
                    padded[r, c], padded[r + 1, c], padded[r + 2, c], padded[r + 3, c], padded[r + 4, c],
                    padded[r + 5, c], padded[r + 6, c],
                )  # fmt: skip
        else:
            row = padded[r]
            for c in range(width):
                found[r, c] = _median(
                    row[c], row[c + 1], row[c + 2], row[c + 3], row[c + 4], row[c + 5], row[c + 6]
                )


@njit(inline="always")
def _median(a, b, c, d, e, f, g):  # type: ignore[no-untyped-def]
    """Of seven numbers, by comparing pairs without branches (a sorting network that stops at the median)."""
    a, f = min(a, f), max(a, f)
    a, d = min(a, d), max(a, d)
    b, g = min(b, g), max(b, g)
    c, e = min(c, e), max(c, e)
    b = max(a, b)
    d, f = min(d, f), max(d, f)
    c, g = min(c, g), max(c, g)
    d = max(c, d)
    d = min(d, g)
    e = min(e, f)
    b, e = min(b, e), max(b, e)
    d = max(b, d)
    return min(d, e)
