"""Means over square windows around all pixels of an image, in numba."""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def window_mean(plane, reach):  # type: ignore[no-untyped-def]
    """Overwrite each value (h, w) float32 by the mean over its window, `reach` pixels to each side.

    Beyond the border all is 0.
    """
    rows, columns = plane.shape
    # Sums that run along an image lose digits in single precision.
    running, line = np.zeros(columns), np.empty(columns)
    share = 1.0 / (2 * reach + 1) ** 2
    for r in range(rows):
        line[:] = plane[r]
        total = line[: min(reach, columns)].sum()
        for c in range(columns):
            total += line[c + reach] if c + reach < columns else 0.0
            plane[r, c] = total
            total -= line[c - reach] if c >= reach else 0.0
    before = np.zeros((reach + 1, columns), np.float32)
    for r in range(min(reach, rows)):
        running += plane[r]
    for r in range(rows):
        # The row is replaced now, and leaves the sums later.
        own = before[r % (reach + 1)]
        leaving = r > reach
        entering = r + reach < rows
        for c in range(columns):
            if leaving:
                running[c] -= own[c]
            if entering:
                running[c] += plane[r + reach, c]
            own[c] = plane[r, c]
            plane[r, c] = running[c] * share
