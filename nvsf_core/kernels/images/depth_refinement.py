"""Depth maps at full size: a pixel's surface is chosen of those around it, and asked of other maps, in numba.

All depths are inverse depths along z, 1/m; 0 = unknown. A depth map has the size of its image.
"""

import math

import numpy as np
from numba import njit

_WINDOW, _STEP_PX = 3, 2
"""Differences are averaged over every second pixel, so many on each side, of similar colour."""
_REACH_PX = np.float32(4.0)
"""A pixel's weight falls to 1/e at this distance,"""
_ALIKE = np.float32(0.04)
"""and to a half at this difference of colours, which are 0..1."""
_UNLIKE = np.float32(6.0)
"""Colours that differ by so many times as much count for nothing."""
_NEARER_COSTS = np.float32(0.001)
"""A surface at half the depth must look more alike by so much: beside an edge, an even background looks the
same at the depth of what stands before it."""
_AGREE_SHARE, _AGREE_PER_M = np.float32(0.05), np.float32(0.002)
"""Two maps agree if their inverse depths differ by at most this share plus so much, 1/m."""
_ZERO, _ONE, _THIRD = np.float32(0.0), np.float32(1.0), np.float32(1.0 / 3.0)


def likeliest_surface(image: np.ndarray, layers: np.ndarray, difference: np.ndarray) -> np.ndarray:
    """Of the surfaces that each pixel of an image may show, the one at which other images look most alike.

    Differences are averaged over the pixels around that have a similar colour, so that the edges between
    surfaces are those of the image.

    Args:
        image: (H, W, c) float32; the first three channels are the colour, 0..1.
        layers: (d, H, W) float32: depths to choose from; the first one where all are equal.
        difference: (d, H, W) float32 of colours in other images at these depths, 0..1; equal ones for
            equal depths.

    Returns:
        (H, W) float32, 1/m.
    """
    found = layers[0].copy()
    _choose(image, layers, difference, found)
    return found


@njit(cache=True, nogil=True)
def _choose(image, layers, difference, found):  # type: ignore[no-untyped-def]
    count, rows, columns = layers.shape
    side = 2 * _WINDOW + 1
    near = np.empty((side, side), np.float32)
    for i in range(side):
        for j in range(side):
            near[i, j] = math.exp(-_STEP_PX * math.hypot(i - _WINDOW, j - _WINDOW) / _REACH_PX)
    mean = np.empty(count, np.float32)
    for r in range(rows):
        for c in range(columns):
            differs = False
            for d in range(1, count):
                differs = differs or layers[d, r, c] != layers[0, r, c]
            if not differs:
                continue
            _average(image, difference, near, r, c, mean)
            best, least = _ZERO, np.float32(np.inf)
            for d in range(count):
                q = layers[d, r, c]
                if q > _ZERO:
                    cost = mean[d] + _NEARER_COSTS * np.float32(math.log2(q))
                    if cost < least:
                        best, least = q, cost
            found[r, c] = best


@njit(inline="always")
def _average(image, difference, near, row, column, mean):  # type: ignore[no-untyped-def]
    """Write the weighted means (d,) of the differences around a pixel."""
    count, rows, columns = difference.shape
    red, green, blue = image[row, column, 0], image[row, column, 1], image[row, column, 2]
    mean[:] = _ZERO
    whole = _ZERO
    for i in range(2 * _WINDOW + 1):
        r = row + (i - _WINDOW) * _STEP_PX
        if r < 0 or r >= rows:
            continue
        for j in range(2 * _WINDOW + 1):
            c = column + (j - _WINDOW) * _STEP_PX
            if c < 0 or c >= columns:
                continue
            one = image[r, c]
            apart = (abs(one[0] - red) + abs(one[1] - green) + abs(one[2] - blue)) * (_THIRD / _ALIKE)
            if apart < _UNLIKE:
                square = apart * apart
                weight = near[i, j] / (_ONE + square * square)
                whole += weight
                for d in range(count):
                    mean[d] += weight * difference[d, r, c]
    for d in range(count):
        mean[d] /= whole


def confirmed(
    inverse: np.ndarray, motions: np.ndarray, others: np.ndarray, is_static: np.ndarray, least: int
) -> np.ndarray:
    """A depth map (H, W) float32, 1/m; negative where too few other images' maps agree with a static depth.

    Args:
        inverse: (H, W) float32 of the image, 1/m.
        motions: (k, 3, 4) float32 from points (u, v, 1, q) of the image, q the inverse depth, to
            pixels of each other image times z.
        others: (k, H, W) float32, their depth maps, 1/m.
        is_static: (H, W) bool: pixels that are asked about; the others stay.
        least: So many must agree, or all that know the place, if fewer do.
    """
    found = inverse.copy()
    _ask(inverse, motions, others, is_static, least, found)
    return found


@njit(cache=True, nogil=True)
def _ask(inverse, motions, others, is_static, least, found):  # type: ignore[no-untyped-def]
    rows, columns = inverse.shape
    for r in range(rows):
        for c in range(columns):
            q = inverse[r, c]
            if not q > _ZERO or not is_static[r, c]:
                continue
            agree, known = 0, 0
            for k in range(len(motions)):
                m = motions[k]
                z = m[2, 0] * c + m[2, 1] * r + m[2, 2] + m[2, 3] * q
                if not z > np.float32(1e-3):
                    continue
                u = (m[0, 0] * c + m[0, 1] * r + m[0, 2] + m[0, 3] * q) / z
                v = (m[1, 0] * c + m[1, 1] * r + m[1, 2] + m[1, 3] * q) / z
                if u >= -0.5 and v >= -0.5 and u < columns - 0.5 and v < rows - 0.5:
                    there, own = others[k, math.floor(v + 0.5), math.floor(u + 0.5)], q / z
                    if there > _ZERO:
                        known += 1
                        agree += abs(there - own) <= _AGREE_SHARE * max(there, own) + _AGREE_PER_M
            if agree < min(least, known):
                found[r, c] = -q
