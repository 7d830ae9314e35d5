"""Planes through the points around each pixel of an image: a surface's depth at the pixel's centre, in numba.

A return lies anywhere in its pixel. On a slanted surface, as the road, its depth is not that of the centre.
"""

import math

import numpy as np
from numba import njit

_RADIUS_PX, _SIGMA_PX = 3, 1.5
"""Points in a square of this half side make a pixel's plane; weights fall as a Gaussian of this width."""
_SHARE, _PER_M = np.float32(0.1), np.float32(0.002)
"""Points of the pixel's own surface: their inverse depth differs by at most this share plus so much, 1/m."""
_FEWEST_POINTS = 4
_MOST_WEIGHT = np.float32(4.0)
"""More points than these in one pixel count no more."""
_TOGETHER = 256
"""Pixels of a row whose points are added up together: few enough that the sums stay in the nearest cache."""
_RIDGE_PX2 = np.float32(0.05)
"""Added to the points' variance along both axes: points in a line make no steep plane across it."""
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)


def on_planes(places: np.ndarray, inverse: np.ndarray, is_near: np.ndarray) -> np.ndarray:
    """Inverse depths at pixel centres, by planes through the points around.

    The inverse depth of a plane is linear in column and row. A plane is fitted, by weighted least squares, to
    the points around a pixel that are of its own surface.

    Args:
        places: (H, W, 4) float32 of points in each pixel: number, mean column, row, and inverse depth, 1/m.
        inverse: (H, W) float32, 1/m: a guess, which tells the pixel's surface.
        is_near: (H, W) bool: pixels that are fitted; the others, and those with few points, keep the guess.
    """
    found, rim = inverse.copy(), (_RADIUS_PX, _RADIUS_PX)
    _fit_planes(np.pad(places.transpose(2, 0, 1), ((0, 0), rim, rim)), inverse, is_near, found)
    return found


@njit(cache=True, nogil=True)
def _fit_planes(places, inverse, is_near, found):  # type: ignore[no-untyped-def]
    """The same, in place; `places` (4, H + 2 rim, W + 2 rim), without points in its rim."""
    side = 2 * _RADIUS_PX + 1
    weights, widened = np.empty((side, side), np.float32), np.empty((side, side), np.float32)
    for i in range(side):
        for j in range(side):
            square = (i - _RADIUS_PX) ** 2 + (j - _RADIUS_PX) ** 2
            weights[i, j] = math.exp(-0.5 * square / _SIGMA_PX**2)
            # A surface may slant: farther away its points may differ by more.
            widened[i, j] = 1.0 + math.sqrt(square) / _RADIUS_PX
    sums, values = np.empty((10, _TOGETHER), np.float32), np.empty((7, _TOGETHER), np.float32)
    rows, columns = inverse.shape
    column = np.arange(columns).astype(np.float32)
    for r in range(rows):
        for first in range(0, columns, _TOGETHER):
            last = min(first + _TOGETHER, columns)
            if not is_near[r, first:last].any():
                continue
            sums[:] = _ZERO
            guess, own_column, own_row = inverse[r, first:last], column[first:last], np.float32(r)
            for i in range(side):
                for j in range(side):
                    _add_points(
                        places, (r + i, first + j), guess, (own_row, own_column),
                        (weights[i, j], widened[i, j]), values, sums,
                    )  # fmt: skip
            for c in range(first, last):
                if is_near[r, c] and sums[0, c - first] >= _FEWEST_POINTS:
                    found[r, c] = _plane_at(sums[1:, c - first], inverse[r, c])


@njit(inline="always")
def _add_points(places, at, guess, pixel, near, values, sums):  # type: ignore[no-untyped-def]
    """Add the points of n pixels, from `at` on, to the sums (10, n) of the pixels beside them."""
    size, (row, first) = len(guess), at
    points, u = places[0, row][first : first + size], places[1, row][first : first + size]
    v, depth = places[2, row][first : first + size], places[3, row][first : first + size]
    own, is_own, weight = values[0][:size], values[1][:size], values[2][:size]
    right, down, along, across = values[3][:size], values[4][:size], values[5][:size], values[6][:size]
    own_row, own_column = pixel
    # Short loops without branches over few arrays: each is computed many pixels at a time.
    for k in range(size):
        # Differences to the guess, so that single precision suffices.
        own[k] = depth[k] - guess[k]
    for k in range(size):
        inside = abs(own[k]) <= (_SHARE * guess[k] + _PER_M) * near[1]
        is_own[k] = _ONE if inside & (points[k] > _ZERO) else _ZERO
    for k in range(size):
        weight[k] = near[0] * min(points[k], _MOST_WEIGHT) * is_own[k]
    for k in range(size):
        right[k], down[k] = u[k] - own_column[k], v[k] - own_row
    for k in range(size):
        along[k], across[k] = weight[k] * right[k], weight[k] * down[k]
    _add(sums[0], is_own)
    _add(sums[1], weight)
    _add(sums[2], along)
    _add(sums[3], across)
    _add_product(sums[4], weight, own)
    _add_product(sums[5], along, right)
    _add_product(sums[6], along, down)
    _add_product(sums[7], across, down)
    _add_product(sums[8], along, own)
    _add_product(sums[9], across, own)


@njit(inline="always")
def _add(total, value):  # type: ignore[no-untyped-def]
    for k in range(len(value)):
        total[k] += value[k]


@njit(inline="always")
def _add_product(total, value, by):  # type: ignore[no-untyped-def]
    for k in range(len(value)):
        total[k] += value[k] * by[k]


@njit(inline="always")
def _plane_at(sums, guess):  # type: ignore[no-untyped-def]
    """Inverse depth at a pixel's centre of the plane through the points whose sums (9,) are given."""
    n, x, y, q, xx, xy, yy, xq, yq = sums
    x, y, q = x / n, y / n, q / n
    xx, xy, yy = xx / n - x * x + _RIDGE_PX2, xy / n - x * y, yy / n - y * y + _RIDGE_PX2
    xq, yq = xq / n - x * q, yq / n - y * q
    area = xx * yy - xy * xy
    moved = q - x * (yy * xq - xy * yq) / area - y * (xx * yq - xy * xq) / area
    return guess + moved if abs(moved) <= _SHARE * guess + _PER_M else guess
