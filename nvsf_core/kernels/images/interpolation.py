"""Values between the pixels of an image, bilinear and bicubic, in numba. An image is a row of numbers."""

import numpy as np
from numba import njit

_ZERO, _HALF, _ONE, _THREE = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(3.0)
"""With a Python number, or an integer, numba would compute in double precision."""
_U0 = np.uint64(0)
"""Indices are unsigned, so that numba need not ask whether they count from the end."""
_RIM_PX = np.float32(0.01)
"""An image shows points that lie outside its outermost pixel centres by no more than rounding may do."""
_RIM_SHARE = np.float32(1e-3)
"""Of a pixel that shows nothing, the weight in a bicubic value that makes it bilinear."""
_GREEN, _BLUE, SHOWN, DEPTH, MOVING = (np.uint64(channel) for channel in range(1, 6))
"""Channels of the images, see `nvsf_core.rendering.sources.Sources`."""


@njit(inline="always")
def corner(size, u, v):  # type: ignore[no-untyped-def]
    """Whether an image of a size has column u and row v; the upper left of four pixels, and the rests."""
    rows, columns, _ = size
    right_most, lowest = np.float32(columns - 1), np.float32(rows - 1)
    if not (u >= -_RIM_PX and v >= -_RIM_PX and u <= right_most + _RIM_PX and v <= lowest + _RIM_PX):
        return False, _U0, _ZERO, _ZERO
    u, v = min(max(u, _ZERO), right_most), min(max(v, _ZERO), lowest)
    row, column = min(int(v), rows - 2), min(int(u), columns - 2)
    return True, np.uint64(row * columns + column), v - np.float32(row), u - np.float32(column)


@njit(inline="always")
def weights_of(down, right):  # type: ignore[no-untyped-def]
    """Of four pixels in a bilinear value: upper left, upper right, lower left, lower right."""
    upper = _ONE - down
    return upper * (_ONE - right), upper * right, down * (_ONE - right), down * right


@njit(inline="always")
def between(image, at, beside, below, channel, weights):  # type: ignore[no-untyped-def]
    """Bilinear value of a channel between four pixels.

    Args:
        image: All numbers of the image, flat.
        at: Where those of the upper left pixel begin.
        beside: How much farther on those of the pixel to its right begin.
        below: And those of the pixel below.
        channel: Place of the channel among a pixel's numbers.
        weights: Of the four, see `weights_of`.
    """
    here = at + channel
    return (
        weights[0] * image[here] + weights[1] * image[here + beside]
        + weights[2] * image[here + below] + weights[3] * image[here + below + beside]
    )  # fmt: skip


@njit(inline="always")
def _cubic(t):  # type: ignore[no-untyped-def]
    """Of four pixels in a row, in a value at t in 0..1 from the second to the third."""
    two, four, five = np.float32(2.0), np.float32(4.0), np.float32(5.0)
    t2 = t * t
    t3 = t2 * t
    return (
        _HALF * (two * t2 - t3 - t), _HALF * (_THREE * t3 - five * t2 + two),
        _HALF * (four * t2 - _THREE * t3 + t), _HALF * (t3 - t2),
    )  # fmt: skip


@njit(inline="always")
def bicubic(image, size, pixel, down, right):  # type: ignore[no-untyped-def]
    """Bicubic colour of 4 x 4 pixels; bilinear if one of them shows nothing.

    Beyond the image's border its outermost pixels are repeated.

    Args:
        image: All numbers of the image, flat.
        size: Its rows, columns and channels.
        pixel: Number of the first of the inner four pixels.
        down: How far below it the place is, 0..1 pixels.
        right: How far to its right.
    """
    rows, columns, channels = size
    row, column = np.int64(pixel) // columns, np.int64(pixel) % columns
    along, across = _cubic(down), _cubic(right)
    red, green, blue, shown = _ZERO, _ZERO, _ZERO, _ZERO
    is_inner = row > 0 and column > 0 and row < rows - 2 and column < columns - 2
    for j in range(4):
        start = (row + j - 1 if is_inner else min(max(row + j - 1, 0), rows - 1)) * columns
        for i in range(4):
            beside = column + i - 1 if is_inner else min(max(column + i - 1, 0), columns - 1)
            here = np.uint64((start + beside) * channels)
            weight = along[j] * across[i]
            red += weight * image[here]
            green += weight * image[here + _GREEN]
            blue += weight * image[here + _BLUE]
            shown += weight * image[here + SHOWN]
    if abs(shown - _ONE) > _RIM_SHARE:
        weights, beside, below = weights_of(down, right), np.uint64(channels), np.uint64(columns * channels)
        at = pixel * beside
        red = between(image, at, beside, below, _U0, weights)
        green = between(image, at, beside, below, _GREEN, weights)
        blue = between(image, at, beside, below, _BLUE, weights)
    return red, green, blue
