"""Colours that recorded images show at points of a view, and how well they agree there, in numba.

The same as torch's operations in `nvsf_core.rendering.sources` and `plane_volume`, without the dozens of
arrays that these store in between.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import njit

_ZERO, _HALF, _ONE, _THREE = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(3.0)
"""With a Python number, or an integer, numba would compute in double precision."""
_U0 = np.uint64(0)
"""Indices are unsigned, so that numba need not ask whether they count from the end."""
_NEAREST_Z = np.float32(1e-3)
"""Smallest z of a point scaled by its inverse depth; with less it counts as behind the source."""
_OUTSIDE = np.float32(-1e9)
"""Column of a point that is behind the source."""
_RIM_PX = np.float32(0.01)
"""An image shows points that lie outside its outermost pixel centres by no more than rounding may do."""
_ALMOST = np.float32(0.999)
_RIM_SHARE = np.float32(1e-3)
"""Of a pixel that shows nothing, the weight in a bicubic value that makes it bilinear."""
_GREEN, _BLUE, _SHOWN, _DEPTH, _MOVING = (np.uint64(channel) for channel in range(1, 6))
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


def look_up_points(where: LookUp) -> tuple[np.ndarray, np.ndarray]:
    """Colours of k images at d depths of each pixel, bicubic as `nvsf_core.rendering.warping.sample_cubic`.

    Returns:
        colour (k, 3, d, h, w) float32, about 0..1, 0 where the image does not show the point; and whether it
        does, seen (k, d, h, w) bool.
    """
    count, shape = len(where.chosen), where.shape
    colour = np.empty((count, 3, *shape), np.float32)
    seen = np.empty((count, *shape), np.bool_)
    _look_up(*_flat(where), colour, seen)
    return colour, seen


def agreement(where: LookUp, unseen_difference: float, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How well k images agree at d depths of each pixel; their colours are bilinear, for speed.

    Args:
        where: Images and points.
        unseen_difference: Difference of two colours where fewer than two images show the point.
        weight: (k,) float32 of the images in the colour that is returned.

    Returns:
        (d, h, w, 6) float32: mean difference of all colours to their mean, difference of the first two,
        share of the images that show the point, mean colour; and the weighted mean colour (d, h, w, 3).
    """
    agreed, colour = np.empty((*where.shape, 6), np.float32), np.empty((*where.shape, 3), np.float32)
    _agree(*_flat(where), np.float32(unseen_difference), weight, agreed, colour)
    return agreed, colour


def least_differences(where: LookUp, unseen_difference: float) -> np.ndarray:
    """How little images differ from an image's own colours at d depths of each of its pixels.

    Any surface is hidden in some images: the mean is of the half of the images that differ least.

    Args:
        where: Images and points; the first image is the one whose pixels they are, the others are compared
            with it.
        unseen_difference: The largest difference of two colours, and that at unknown depths or where no other
            image shows the point.

    Returns:
        (d, h, w) float32, 0..1; 0 for pixels whose depths are all equal: nothing is to be compared.
    """
    found = np.empty(where.shape, np.float32)
    _differ(*_flat(where), np.float32(unseen_difference), found)
    return found


def _flat(where: LookUp) -> tuple[Any, ...]:
    """The first arguments of all three kernels: images as rows of numbers, and the size of one."""
    images = where.images.reshape(len(where.images), -1)
    return (images, where.images.shape[1:], *where[1:-1], *where.hiding)


@njit(inline="always")
def _starts(motions, label, rays, row, k, starts, steps):  # type: ignore[no-untyped-def]
    """Write what places of a row's pixels in image k begin with, (3, w), and their steps by inverse depth."""
    for i in range(3):
        for c in range(rays.shape[1]):
            motion = motions[label[row, c], k]
            starts[i, c] = motion[i, 0] * rays[row, c, 0] + motion[i, 1] * rays[row, c, 1] + motion[i, 2]
            steps[i, c] = motion[i, 3]


@njit(inline="always")
def _project(starts, steps, inverse, place):  # type: ignore[no-untyped-def]
    """Write column, row and scale 1/z (3, w) of a row's points; far outside if behind the source."""
    # No branches: this loop is computed eight pixels at a time.
    for c in range(len(inverse)):
        q = inverse[c]
        z = starts[2, c] + q * steps[2, c]
        in_front = z > _NEAREST_Z
        scale = _ONE / (z if in_front else _ONE)
        place[0, c] = (starts[0, c] + q * steps[0, c]) * scale if in_front else _OUTSIDE
        place[1, c] = (starts[1, c] + q * steps[1, c]) * scale
        place[2, c] = scale


@njit(inline="always")
def _corner(size, u, v):  # type: ignore[no-untyped-def]
    """Whether an image of a size has column u and row v; the upper left of four pixels, and the rests."""
    rows, columns, _ = size
    right_most, lowest = np.float32(columns - 1), np.float32(rows - 1)
    if not (u >= -_RIM_PX and v >= -_RIM_PX and u <= right_most + _RIM_PX and v <= lowest + _RIM_PX):
        return False, _U0, _ZERO, _ZERO
    u, v = min(max(u, _ZERO), right_most), min(max(v, _ZERO), lowest)
    row, column = min(int(v), rows - 2), min(int(u), columns - 2)
    return True, np.uint64(row * columns + column), v - np.float32(row), u - np.float32(column)


@njit(inline="always")
def _weights(down, right):  # type: ignore[no-untyped-def]
    """Of four pixels in a bilinear value: upper left, upper right, lower left, lower right."""
    upper = _ONE - down
    return upper * (_ONE - right), upper * right, down * (_ONE - right), down * right


@njit(inline="always")
def _between(image, at, beside, below, channel, weights):  # type: ignore[no-untyped-def]
    """Bilinear value of a channel between four pixels, `at` that of the upper left one."""
    here = at + channel
    return (
        weights[0] * image[here] + weights[1] * image[here + beside]
        + weights[2] * image[here + below] + weights[3] * image[here + below + beside]
    )  # fmt: skip


@njit(inline="always")
def _shows(image, at, beside, below, weights, hiding, asks_moving):  # type: ignore[no-untyped-def]
    """Whether an image (flat) shows a point that only inverse depths above `hiding` hide."""
    return (
        _between(image, at, beside, below, _SHOWN, weights) > _ALMOST
        and not _between(image, at, beside, below, _DEPTH, weights) > hiding
        and not (asks_moving and _between(image, at, beside, below, _MOVING, weights) > _HALF)
    )


@njit(cache=True, nogil=True)
def _open_pixels(images, size, chosen):  # type: ignore[no-untyped-def]
    """(k, H * W) bool: pixels that show points of any depth, between them and those right and below, too.

    They show something static of unknown depth. Before images have depths these are nearly all, and need
    not be asked one by one.
    """
    rows, columns, channels = size
    shown, depth, moving = np.int64(_SHOWN), np.int64(_DEPTH), np.int64(_MOVING)
    found = np.zeros((len(chosen), rows * columns), np.bool_)
    for k in range(len(chosen)):
        image = images[chosen[k]]
        for row in range(rows - 1):
            # From right to left, so that both pixels to the right are known already.
            right = False
            for column in range(columns - 1, -1, -1):
                here = True
                for below in range(2):
                    at = ((row + below) * columns + column) * channels
                    here = here and image[at + shown] > _ALMOST and image[at + depth] == _ZERO
                    here = here and (channels == moving or image[at + moving] == _ZERO)
                found[k, row * columns + column] = here and right
                right = here
    return found


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
def _smooth(image, size, pixel, down, right):  # type: ignore[no-untyped-def]
    """Bicubic colour of 4 x 4 pixels, `pixel` the first of the inner four; bilinear if one shows nothing.

    Beyond the image's border its outermost pixels are repeated.
    """
    rows, columns, channels = size
    row, column = np.int64(pixel) // columns, np.int64(pixel) % columns
    along, across = _cubic(down), _cubic(right)
    red, green, blue, shown = _ZERO, _ZERO, _ZERO, _ZERO
    for j in range(4):
        start = min(max(row + j - 1, 0), rows - 1) * columns
        for i in range(4):
            here = np.uint64((start + min(max(column + i - 1, 0), columns - 1)) * channels)
            weight = along[j] * across[i]
            red += weight * image[here]
            green += weight * image[here + _GREEN]
            blue += weight * image[here + _BLUE]
            shown += weight * image[here + _SHOWN]
    if abs(shown - _ONE) > _RIM_SHARE:
        weights, beside, below = _weights(down, right), np.uint64(channels), np.uint64(columns * channels)
        at = pixel * beside
        red = _between(image, at, beside, below, _U0, weights)
        green = _between(image, at, beside, below, _GREEN, weights)
        blue = _between(image, at, beside, below, _BLUE, weights)
    return red, green, blue


@njit(cache=True, nogil=True)
def _look_up(  # type: ignore[no-untyped-def]
    images, size, chosen, motions, rays, label, inverse, share, per_m, colour, seen
):
    rows, columns, _ = rays.shape
    beside, below = np.uint64(size[2]), np.uint64(size[1] * size[2])
    has_moving = size[2] > _MOVING
    starts = np.empty((3, columns), np.float32)
    steps, place = np.empty_like(starts), np.empty_like(starts)
    for k in range(len(chosen)):
        image = images[chosen[k]]
        for r in range(rows):
            _starts(motions, label, rays, r, k, starts, steps)
            for d in range(len(inverse)):
                depths = _row_of(inverse, d, r, columns)
                _project(starts, steps, depths, place)
                for c in range(columns):
                    is_seen, pixel, down, right = _corner(size, place[0, c], place[1, c])
                    if is_seen:
                        weights = _weights(down, right)
                        hiding = depths[c] * place[2, c] * (_ONE + share) + per_m
                        asks_moving = has_moving and label[r, c] == 0
                        is_seen = _shows(image, pixel * beside, beside, below, weights, hiding, asks_moving)
                    found = _smooth(image, size, pixel, down, right) if is_seen else (_ZERO, _ZERO, _ZERO)
                    seen[k, d, r, c] = is_seen
                    colour[k, 0, d, r, c], colour[k, 1, d, r, c], colour[k, 2, d, r, c] = found


@njit(inline="always")
def _row_of(inverse, d, r, columns):  # type: ignore[no-untyped-def]
    """Inverse depths (w,) of a row's pixels on plane d of (d, h, w), or of (d, 1, 1)."""
    return inverse[d, r] if inverse.shape[1] > 1 else np.full(columns, inverse[d, 0, 0])


@njit(cache=True, nogil=True)
def _agree(  # type: ignore[no-untyped-def]
    images, size, chosen, motions, rays, label, inverse, share, per_m, unseen, weight, agreed, colour
):
    rows, columns, _ = rays.shape
    beside, below = np.uint64(size[2]), np.uint64(size[1] * size[2])
    count, has_moving, is_open = len(chosen), size[2] > _MOVING, _open_pixels(images, size, chosen)
    starts = np.empty((count, 3, columns), np.float32)
    steps, place = np.empty_like(starts), np.empty_like(starts)
    found, is_seen = np.zeros((count, 3), np.float32), np.zeros(count, np.bool_)
    for r in range(rows):
        for k in range(count):
            _starts(motions, label, rays, r, k, starts[k], steps[k])
        for d in range(len(inverse)):
            depths = _row_of(inverse, d, r, columns)
            for k in range(count):
                _project(starts[k], steps[k], depths, place[k])
            for c in range(columns):
                asks_moving = has_moving and label[r, c] == 0
                for k in range(count):
                    image = images[chosen[k]]
                    is_inside, pixel, down, right = _corner(size, place[k, 0, c], place[k, 1, c])
                    is_seen[k] = False
                    if is_inside:
                        at, weights = pixel * beside, _weights(down, right)
                        hiding = depths[c] * place[k, 2, c] * (_ONE + share) + per_m
                        is_seen[k] = is_open[k, pixel] or _shows(
                            image, at, beside, below, weights, hiding, asks_moving
                        )
                        for i in range(3):
                            found[k, i] = _between(image, at, beside, below, np.uint64(i), weights)
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


@njit(cache=True, nogil=True)
def _differ(  # type: ignore[no-untyped-def]
    images, size, chosen, motions, rays, label, inverse, share, per_m, unseen, found
):
    rows, columns, _ = rays.shape
    beside, below = np.uint64(size[2]), np.uint64(size[1] * size[2])
    has_moving, own = size[2] > _MOVING, images[chosen[0]]
    count, is_open = len(chosen) - 1, _open_pixels(images, size, chosen)
    starts = np.empty((count, 3, columns), np.float32)
    steps, place = np.empty_like(starts), np.empty_like(starts)
    apart, asked = np.empty(count, np.float32), np.empty(columns, np.bool_)
    for r in range(rows):
        for k in range(count):
            _starts(motions, label, rays, r, k + 1, starts[k], steps[k])
        for c in range(columns):
            asked[c] = False
            for d in range(1, len(inverse)):
                asked[c] = asked[c] or inverse[d, r, c] != inverse[0, r, c]
        for d in range(len(inverse)):
            depths = inverse[d, r]
            for k in range(count):
                _project(starts[k], steps[k], depths, place[k])
            for c in range(columns):
                if not asked[c] or (d > 0 and depths[c] == inverse[0, r, c]):
                    found[d, r, c] = found[0, r, c] if asked[c] else _ZERO
                    continue
                here = np.uint64((r * columns + c) * size[2])
                seen = 0
                for k in range(count if depths[c] > _ZERO else 0):
                    image = images[chosen[k + 1]]
                    is_inside, pixel, down, right = _corner(size, place[k, 0, c], place[k, 1, c])
                    if not is_inside:
                        continue
                    at, weights = pixel * beside, _weights(down, right)
                    hiding = depths[c] * place[k, 2, c] * (_ONE + share) + per_m
                    if is_open[k + 1, pixel] or _shows(
                        image, at, beside, below, weights, hiding, has_moving and label[r, c] == 0
                    ):
                        total = _ZERO
                        for i in range(3):
                            channel = np.uint64(i)
                            there = _between(image, at, beside, below, channel, weights)
                            total += abs(there - own[here + channel])
                        _insert(apart, seen, min(total * np.float32(1.0 / 3.0), unseen))
                        seen += 1
                half, total = (seen + 1) // 2, _ZERO
                for k in range(half):
                    total += apart[k]
                found[d, r, c] = total / np.float32(half) if half > 0 else unseen


@njit(inline="always")
def _insert(ascending, count, value):  # type: ignore[no-untyped-def]
    """Insert a value among the first `count` of a list in ascending order."""
    k = count
    while k > 0 and ascending[k - 1] > value:
        ascending[k] = ascending[k - 1]
        k -= 1
    ascending[k] = value
