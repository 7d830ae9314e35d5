"""Colours that recorded images show at points of a view, and how well they agree there, in numba.

The same as torch's operations in `nvsf_core.rendering.sources` and `plane_volume`, without the dozens of
arrays that these store in between.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import njit

_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
"""With a Python number, or an integer, numba would compute in double precision."""
_U0 = np.uint64(0)
"""Indices are unsigned, so that numba need not ask whether they count from the end."""
_NEAREST_Z = np.float32(1e-3)
"""Smallest z of a point scaled by its inverse depth; with less it counts as behind the source."""
_RIM_PX = np.float32(0.01)
"""An image shows points that lie outside its outermost pixel centres by no more than rounding may do."""
_ALMOST = np.float32(0.999)
_SHOWN, _DEPTH, _MOVING = np.uint64(3), np.uint64(4), np.uint64(5)
"""Channels of the images, see `nvsf_core.rendering.sources.Sources`."""


class LookUp(NamedTuple):
    """k images, and d points of each pixel of a view that are looked up in them."""

    images: np.ndarray
    """(j, H, W, c) float32, channels as in `Sources.images`."""
    chosen: np.ndarray
    """(k,) int64, which of them."""
    motions: np.ndarray
    """(m, k, 3, 4) float32 from points (x, y, 1, q) of the view, q the inverse depth along z, to pixels of
    each image times z; of what is static, then of each moving object. Zeros = unknown."""
    rays: np.ndarray
    """(h, w, 3) float32 directions (x, y, 1) of the pixels."""
    label: np.ndarray
    """(h, w) uint8, which of the m motions a pixel has."""
    inverse: np.ndarray
    """(d, h, w), or (d, 1, 1) the same for all pixels, float32, 1/m."""
    hiding: tuple[np.float32, np.float32]
    """Share, and inverse depth in 1/m, of `nvsf_core.rendering.sources.hides`."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """d, h, w."""
        return len(self.inverse), self.rays.shape[0], self.rays.shape[1]


def look_up_points(where: LookUp, *, with_slope: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Colours of k images at d depths of each pixel.

    Args:
        where: Images and points.
        with_slope: Also the colours' derivative by the inverse depth.

    Returns:
        colour (k, 3, d, h, w) float32, 0 where the image does not show the point; whether it does, seen
        (k, d, h, w) bool; and the derivative, as the colour, or without any element.
    """
    count, shape = len(where.chosen), where.shape
    colour = np.empty((count, 3, *shape), np.float32)
    slope = np.empty(colour.shape if with_slope else (0, 3, *shape), np.float32)
    seen = np.empty((count, *shape), np.bool_)
    _look_up(*_flat(where), colour, slope, seen)
    return colour, seen, slope


def agreement(
    where: LookUp, gain: float, unseen_difference: float, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """How well k images agree at d depths of each pixel.

    Args:
        where: Images and points.
        gain: Factor on all colours, which are at most 1 after it.
        unseen_difference: Difference of two colours where fewer than two images show the point.
        weight: (k,) float32 of the images in the colour that is returned.

    Returns:
        (d, h, w, 6) float32: mean difference of all colours to their mean, difference of the first two,
        share of the images that show the point, mean colour; and the weighted mean colour (d, h, w, 3).
    """
    agreed, colour = np.empty((*where.shape, 6), np.float32), np.empty((*where.shape, 3), np.float32)
    _agree(*_flat(where), np.float32(gain), np.float32(unseen_difference), weight, agreed, colour)
    return agreed, colour


def _flat(where: LookUp) -> tuple[Any, ...]:
    """The first arguments of both kernels: images as rows of numbers, and the size of one."""
    images = where.images.reshape(len(where.images), -1)
    return (images, where.images.shape[1:], *where[1:-1], *where.hiding)


@njit(inline="always")
def _between(image, at, beside, below, channel, down, right):  # type: ignore[no-untyped-def]
    """Bilinear value of a channel between four pixels, `at` that of the upper left one."""
    here = at + channel
    upper = image[here] * (_ONE - right) + image[here + beside] * right
    lower = image[here + below] * (_ONE - right) + image[here + below + beside] * right
    return upper * (_ONE - down) + lower * down


@njit(inline="always")
def _place(image, size, motion, x, y, q, is_static, share, per_m):  # type: ignore[no-untyped-def]
    """Whether an image (flat) of a size shows a point; its place: upper left value, rests; its scale 1/z."""
    nowhere = (False, _U0, _ZERO, _ZERO, _ZERO)
    z = motion[2, 0] * x + motion[2, 1] * y + motion[2, 2] + q * motion[2, 3]
    if not z > _NEAREST_Z:
        return nowhere
    scale = _ONE / z
    u = (motion[0, 0] * x + motion[0, 1] * y + motion[0, 2] + q * motion[0, 3]) * scale
    v = (motion[1, 0] * x + motion[1, 1] * y + motion[1, 2] + q * motion[1, 3]) * scale
    rows, columns, channels = size
    right_most, lowest = np.float32(columns - 1), np.float32(rows - 1)
    if not (u >= -_RIM_PX and v >= -_RIM_PX and u <= right_most + _RIM_PX and v <= lowest + _RIM_PX):
        return nowhere
    u, v = min(max(u, _ZERO), right_most), min(max(v, _ZERO), lowest)
    row, column = min(int(v), rows - 2), min(int(u), columns - 2)
    down, right = v - np.float32(row), u - np.float32(column)
    at = np.uint64((row * columns + column) * channels)
    beside, below = np.uint64(channels), np.uint64(columns * channels)
    if not _between(image, at, beside, below, _SHOWN, down, right) > _ALMOST:
        return nowhere
    hiding = q * scale * (_ONE + share) + per_m
    if _between(image, at, beside, below, _DEPTH, down, right) > hiding:
        return nowhere
    if is_static and channels > _MOVING and _between(image, at, beside, below, _MOVING, down, right) > _HALF:
        return nowhere
    return True, at, down, right, scale


@njit(cache=True, nogil=True)
def _look_up(  # type: ignore[no-untyped-def]
    images, size, chosen, motions, rays, label, inverse, share, per_m, colour, slope, seen
):
    rows, columns, _ = rays.shape
    beside, below = np.uint64(size[2]), np.uint64(size[1] * size[2])
    wide, has_slope = inverse.shape[1] > 1, len(slope) > 0
    for k in range(len(chosen)):
        image = images[chosen[k]]
        for d in range(len(inverse)):
            for r in range(rows):
                for c in range(columns):
                    motion = motions[label[r, c], k]
                    q = inverse[d, r, c] if wide else inverse[d, 0, 0]
                    is_seen, at, down, right, scale = _place(
                        image, size, motion, rays[r, c, 0], rays[r, c, 1], q, label[r, c] == 0, share, per_m
                    )
                    seen[k, d, r, c] = is_seen
                    for i in range(3):
                        colour[k, i, d, r, c] = _ZERO
                        if is_seen:
                            colour[k, i, d, r, c] = _between(
                                image, at, beside, below, np.uint64(i), down, right
                            )
                    if has_slope:
                        u_by_q = (motion[0, 3] - _column(at, size, right) * motion[2, 3]) * scale
                        v_by_q = (motion[1, 3] - _row(at, size, down) * motion[2, 3]) * scale
                        for i in range(3):
                            slope[k, i, d, r, c] = _ZERO
                            if is_seen:
                                by_u, by_v = _slopes(image, at, beside, below, np.uint64(i), down, right)
                                slope[k, i, d, r, c] = by_u * u_by_q + by_v * v_by_q


@njit(inline="always")
def _column(at, size, right):  # type: ignore[no-untyped-def]
    return np.float32((np.int64(at) // size[2]) % size[1]) + right


@njit(inline="always")
def _row(at, size, down):  # type: ignore[no-untyped-def]
    return np.float32(np.int64(at) // (size[2] * size[1])) + down


@njit(inline="always")
def _slopes(image, at, beside, below, channel, down, right):  # type: ignore[no-untyped-def]
    """Derivatives of a bilinear value by column and row."""
    here = at + channel
    a, b, e, f = image[here], image[here + beside], image[here + below], image[here + below + beside]
    return (b - a) * (_ONE - down) + (f - e) * down, (e - a) * (_ONE - right) + (f - b) * right


@njit(cache=True, nogil=True)
def _agree(  # type: ignore[no-untyped-def]
    images, size, chosen, motions, rays, label, inverse, share, per_m, gain, unseen, weight, agreed, colour
):
    rows, columns, _ = rays.shape
    beside, below = np.uint64(size[2]), np.uint64(size[1] * size[2])
    wide, count = inverse.shape[1] > 1, len(chosen)
    found, is_seen = np.zeros((count, 3), np.float32), np.zeros(count, np.bool_)
    for r in range(rows):
        for d in range(len(inverse)):
            for c in range(columns):
                q = inverse[d, r, c] if wide else inverse[d, 0, 0]
                for k in range(count):
                    image = images[chosen[k]]
                    is_seen[k], at, down, right, _ = _place(
                        image, size, motions[label[r, c], k], rays[r, c, 0], rays[r, c, 1], q,
                        label[r, c] == 0, share, per_m,
                    )  # fmt: skip
                    if is_seen[k]:
                        for i in range(3):
                            value = _between(image, at, beside, below, np.uint64(i), down, right)
                            found[k, i] = min(gain * value, _ONE)
                _compare(found, is_seen, unseen, weight, agreed[d, r, c], colour[d, r, c])


@njit(inline="always")
def _compare(found, is_seen, unseen, weight, agreed, colour):  # type: ignore[no-untyped-def]
    """Write the agreement (6,) and the weighted mean colour (3,) of a point's colours (k, 3)."""
    zero, third = np.float32(0.0), np.float32(1.0 / 3.0)
    seen, whole = zero, zero
    red, green, blue, r, g, b = zero, zero, zero, zero, zero, zero
    for k in range(len(found)):
        if is_seen[k]:
            seen += np.float32(1.0)
            whole += weight[k]
            red, green, blue = red + found[k, 0], green + found[k, 1], blue + found[k, 2]
            r, g, b = r + weight[k] * found[k, 0], g + weight[k] * found[k, 1], b + weight[k] * found[k, 2]
    if seen > _HALF:
        red, green, blue = red / seen, green / seen, blue / seen
    spread = zero
    for k in range(len(found)):
        if is_seen[k]:
            spread += third * (abs(found[k, 0] - red) + abs(found[k, 1] - green) + abs(found[k, 2] - blue))
    spread = spread / seen if seen > np.float32(1.5) else unseen
    pair = spread
    if len(found) > 1:
        pair = unseen
        if is_seen[0] and is_seen[1]:
            pair = zero
            for i in range(3):
                pair += third * abs(found[0, i] - found[1, i])
    agreed[0], agreed[1], agreed[2] = spread, pair, seen / np.float32(len(found))
    agreed[3], agreed[4], agreed[5] = red, green, blue
    whole = max(whole, np.float32(1e-6))
    colour[0], colour[1], colour[2] = r / whole, g / whole, b / whole
