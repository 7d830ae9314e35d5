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
_RIDGE_PX2 = np.float32(0.05)
"""Added to the points' variance along both axes: points in a line make no steep plane across it."""


def on_planes(places: np.ndarray, inverse: np.ndarray, is_near: np.ndarray) -> np.ndarray:
    """Inverse depths at pixel centres, by planes through the points around.

    The inverse depth of a plane is linear in column and row. A plane is fitted, by weighted least squares, to
    the points around a pixel that are of its own surface.

    Args:
        places: (H, W, 4) float32 of points in each pixel: number, mean column, row, and inverse depth, 1/m.
        inverse: (H, W) float32, 1/m: a guess, which tells the pixel's surface.
        is_near: (H, W) bool: pixels that are fitted; the others, and those with few points, keep the guess.
    """
    found = inverse.copy()
    _fit_planes(places, inverse, is_near, found)
    return found


@njit(cache=True, nogil=True)
def _fit_planes(places, inverse, is_near, found):  # type: ignore[no-untyped-def]
    side = 2 * _RADIUS_PX + 1
    weights, widened = np.empty((side, side), np.float32), np.empty((side, side), np.float32)
    for i in range(side):
        for j in range(side):
            square = (i - _RADIUS_PX) ** 2 + (j - _RADIUS_PX) ** 2
            weights[i, j] = math.exp(-0.5 * square / _SIGMA_PX**2)
            # A surface may slant: farther away its points may differ by more.
            widened[i, j] = 1.0 + math.sqrt(square) / _RADIUS_PX
    for r in range(len(inverse)):
        for c in range(inverse.shape[1]):
            if is_near[r, c]:
                found[r, c] = _plane_at(places, r, c, inverse[r, c], weights, widened)


@njit(inline="always")
def _plane_at(places, row, column, guess, weights, widened):  # type: ignore[no-untyped-def]
    """Inverse depth of the plane through the points around a pixel; the guess where there are too few."""
    rows, columns, _ = places.shape
    most, count, zero = _SHARE * guess + _PER_M, 0, np.float32(0.0)
    n, x, y, q, xx, xy, yy, xq, yq = zero, zero, zero, zero, zero, zero, zero, zero, zero
    for r in range(max(0, row - _RADIUS_PX), min(rows, row + _RADIUS_PX + 1)):
        for c in range(max(0, column - _RADIUS_PX), min(columns, column + _RADIUS_PX + 1)):
            points, i, j = places[r, c, 0], r - row + _RADIUS_PX, c - column + _RADIUS_PX
            # Differences to the guess, so that single precision suffices.
            own = places[r, c, 3] - guess
            if points == zero or abs(own) > most * widened[i, j]:
                continue
            right, down = places[r, c, 1] - np.float32(column), places[r, c, 2] - np.float32(row)
            weight = weights[i, j] * min(points, _MOST_WEIGHT)
            count += 1
            n, x, y, q = n + weight, x + weight * right, y + weight * down, q + weight * own
            xx, xy = xx + weight * right * right, xy + weight * right * down
            yy, xq, yq = yy + weight * down * down, xq + weight * right * own, yq + weight * down * own
    if count < _FEWEST_POINTS:
        return guess
    x, y, q = x / n, y / n, q / n
    xx, xy, yy = xx / n - x * x + _RIDGE_PX2, xy / n - x * y, yy / n - y * y + _RIDGE_PX2
    xq, yq = xq / n - x * q, yq / n - y * q
    area = xx * yy - xy * xy
    moved = q - x * (yy * xq - xy * yq) / area - y * (xx * yq - xy * xq) / area
    return guess + moved if abs(moved) <= most else guess
