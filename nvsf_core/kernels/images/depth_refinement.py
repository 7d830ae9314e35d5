"""Depth maps at full size: a pixel's surface is chosen of those around it, and asked of other maps, in numba.

All depths are inverse depths along z, 1/m; 0 = unknown. A depth map has the size of its image.
"""

import math

import numpy as np
from numba import njit

_WINDOW, _STEP_PX = 3, 2
"""Differences are averaged over every second pixel, so many on each side, of similar colour."""
WINDOW_REACH_PX = _WINDOW * _STEP_PX
"""What a pixel shows depends on no other farther away than this, along rows and along columns."""
_REACH_PX = np.float32(4.0)
"""A pixel's weight falls to 1/e at this distance,"""
_ALIKE = np.float32(0.04)
"""and to a half at this difference of colours, which are 0..1."""
_UNLIKE = np.float32(6.0)
"""Colours that differ by so many times as much count for nothing."""
_BEYOND = 1e3
"""Colour of the rim around an image: unlike any."""
_TOGETHER = 64
"""Pixels of a row that are averaged together: few, as a row has surfaces to choose between only in places."""
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
    found, reach = layers[0].copy(), WINDOW_REACH_PX
    rim = ((0, 0), (reach, reach), (reach, reach))
    colours = np.pad(image[..., :3].transpose(2, 0, 1), rim, constant_values=_BEYOND)
    _choose(colours, layers, np.pad(difference, rim), found)
    return found


@njit(cache=True, nogil=True)
def _choose(colours, layers, difference, found):  # type: ignore[no-untyped-def]
    """The same, in place; `colours` (3, H + 2 rim, W + 2 rim) and `difference` have a rim of the window."""
    count, rows, columns = layers.shape
    side = 2 * _WINDOW + 1
    near = np.empty((side, side), np.float32)
    for i in range(side):
        for j in range(side):
            near[i, j] = math.exp(-_STEP_PX * math.hypot(i - _WINDOW, j - _WINDOW) / _REACH_PX)
    total, weight = np.empty((count + 1, _TOGETHER), np.float32), np.empty(_TOGETHER, np.float32)
    asked = np.empty(_TOGETHER, np.bool_)
    for r in range(rows):
        for first in range(0, columns, _TOGETHER):
            size = min(_TOGETHER, columns - first)
            asked[:] = False
            for d in range(1, count):
                for k in range(size):
                    asked[k] |= layers[d, r, first + k] != layers[0, r, first + k]
            if not asked.any():
                continue
            total[:] = _ZERO
            for i in range(side):
                for j in range(side):
                    at = (r + i * _STEP_PX, first + j * _STEP_PX)
                    own = (r + _WINDOW * _STEP_PX, first + _WINDOW * _STEP_PX)
                    _weigh(colours, own, at, near[i, j], weight[:size])
                    _add(total, difference, at, weight[:size])
            for k in range(size):
                if asked[k]:
                    found[r, first + k] = _best(layers[:, r, first + k], total[:, k])


# The loops over a row's pixels are short and without branches: they are computed many pixels at a time.
@njit(inline="always")
def _weigh(colours, own, at, near, weight):  # type: ignore[no-untyped-def]
    """Write how much the pixels from `at` on count (n,) for those from `own` on, by their colours."""
    (row, first), (r, c), size = own, at, len(weight)
    red, other_red = colours[0, row][first : first + size], colours[0, r][c : c + size]
    green, other_green = colours[1, row][first : first + size], colours[1, r][c : c + size]
    blue, other_blue = colours[2, row][first : first + size], colours[2, r][c : c + size]
    for k in range(size):
        weight[k] = abs(other_red[k] - red[k]) + abs(other_green[k] - green[k]) + abs(other_blue[k] - blue[k])
    for k in range(size):
        apart = weight[k] * (_THIRD / _ALIKE)
        square = apart * apart
        weight[k] = near / (_ONE + square * square) if apart < _UNLIKE else _ZERO


@njit(inline="always")
def _add(total, difference, at, weight):  # type: ignore[no-untyped-def]
    """Add the weighted differences (d, n) of the pixels from `at` on, and last their weight, to `total`."""
    (r, c), size, count = at, len(weight), len(difference)
    for d in range(count):
        to, one = total[d], difference[d, r][c : c + size]
        for k in range(size):
            to[k] += weight[k] * one[k]
    whole = total[count]
    for k in range(size):
        whole[k] += weight[k]


@njit(inline="always")
def _best(layers, total):  # type: ignore[no-untyped-def]
    """Of a pixel's inverse depths (d,), that with the least mean difference."""
    best, least = _ZERO, np.float32(np.inf)
    for d in range(len(layers)):
        q = layers[d]
        if q > _ZERO:
            cost = total[d] / total[len(layers)] + _NEARER_COSTS * np.float32(math.log2(q))
            if cost < least:
                best, least = q, cost
    return best


def confirmed(
    inverse: np.ndarray, motions: np.ndarray, others: np.ndarray, is_static: np.ndarray
) -> np.ndarray:
    """A depth map (H, W) float32, 1/m; negative where other maps know a static depth's place and none agrees.

    Args:
        inverse: (H, W) float32 of the image, 1/m.
        motions: (k, 3, 4) float32 from points (u, v, 1, q) of the image, q the inverse depth, to
            pixels of each other image times z.
        others: (k, H, W) float32, their depth maps, 1/m.
        is_static: (H, W) bool: pixels that are asked about; the others stay.
    """
    found = inverse.copy()
    _ask(inverse, motions, others, is_static, found)
    return found


@njit(cache=True, nogil=True)
def _ask(inverse, motions, others, is_static, found):  # type: ignore[no-untyped-def]
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
            if agree == 0 and known > 0:
                found[r, c] = -q
