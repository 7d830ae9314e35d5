"""Colours that recorded images show at points of a view, and how well they agree there, in numba.

`agreement` is what `nvsf_core.rendering.plane_volume` computes by torch on a GPU, without dozens of arrays.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from nvsf_core.kernels.images.interpolation import (
    DEPTH,
    MOVING,
    SHOWN,
    between,
    bicubic,
    corner,
    weights_of,
)

_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
_THIRD = np.float32(1.0 / 3.0)
"""With a Python number, or an integer, numba would compute in double precision."""
NEAREST_Z = np.float32(1e-3)
"""Smallest z of a point scaled by its inverse depth; with less it counts as behind the source."""
OUTSIDE = np.float32(-1e9)
"""Column of a point that is behind the source."""
_ALMOST = np.float32(0.999)
_FEW = 3
"""Of an image's pixels, less than one of so many."""


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
    """Colours of k images at d depths of each pixel, bicubic (Catmull and Rom).

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


def least_differences(where: LookUp, own: np.ndarray, unseen_difference: float) -> np.ndarray:
    """How little k images differ from pixels of another one at d depths of each.

    Any surface is hidden in some images: the mean is of the half of the images that differ least.

    Args:
        where: The k images, and the points of the pixels: of a whole image or of a part of it.
        own: (h, w, c) float32, the pixels; their first three channels are compared.
        unseen_difference: The largest difference of two colours, and that at unknown depths or where none of
            the images shows the point.

    Returns:
        (d, h, w) float32, 0..1; 0 for pixels whose depths are all equal: nothing is to be compared.
    """
    found = np.empty(where.shape, np.float32)
    _differ(*_flat(where), own, np.float32(unseen_difference), found)
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
        in_front = z > NEAREST_Z
        scale = _ONE / (z if in_front else _ONE)
        place[0, c] = (starts[0, c] + q * steps[0, c]) * scale if in_front else OUTSIDE
        place[1, c] = (starts[1, c] + q * steps[1, c]) * scale
        place[2, c] = scale


@njit(inline="always")
def shows(image, at, beside, below, weights, hiding, asks_moving):  # type: ignore[no-untyped-def]
    """Whether an image (flat) shows a point that only inverse depths above `hiding` hide.

    Args:
        image: All its numbers.
        at: Where those of the upper left of the four pixels around the point begin.
        beside: As of `between`.
        below: As of `between`.
        weights: Of the four pixels.
        hiding: Inverse depth, 1/m.
        asks_moving: Whether a moving object hides it, too.
    """
    return (
        between(image, at, beside, below, SHOWN, weights) > _ALMOST
        and not between(image, at, beside, below, DEPTH, weights) > hiding
        and not (asks_moving and between(image, at, beside, below, MOVING, weights) > _HALF)
    )


@njit(cache=True, nogil=True)
def _open_pixels(images, size, chosen):  # type: ignore[no-untyped-def]
    """(k, H * W) bool: pixels that show points of any depth, between them and those right and below, too.

    They show something static of unknown depth. Before images have depths these are nearly all, and need
    not be asked one by one.
    """
    rows, columns, channels = size
    shown, depth, moving = np.int64(SHOWN), np.int64(DEPTH), np.int64(MOVING)
    found = np.zeros((len(chosen), rows * columns), np.bool_)
    above, here = np.empty(columns, np.bool_), np.empty(columns, np.bool_)
    for k in range(len(chosen)):
        image = images[chosen[k]]
        for row in range(rows):
            above, here = here, above
            pixels = image[row * columns * channels : (row + 1) * columns * channels]
            for c in range(columns):
                at = c * channels
                here[c] = (pixels[at + shown] > _ALMOST) & (pixels[at + depth] == _ZERO)
            for c in range(columns if channels > moving else 0):
                here[c] &= pixels[c * channels + moving] == _ZERO
            if row > 0:
                among = found[k, (row - 1) * columns : row * columns]
                for c in range(columns - 1):
                    among[c] = above[c] & above[c + 1] & here[c] & here[c + 1]
    return found


@njit(cache=True, nogil=True)
def _look_up(  # type: ignore[no-untyped-def]
    images, size, chosen, motions, rays, label, inverse, share, per_m, colour, seen
):
    rows, columns, _ = rays.shape
    beside, below = np.uint64(size[2]), np.uint64(size[1] * size[2])
    has_moving = size[2] > MOVING
    starts = np.empty((3, columns), np.float32)
    steps, place = np.empty_like(starts), np.empty_like(starts)
    for k in range(len(chosen)):
        image = images[chosen[k]]
        for r in range(rows):
            _starts(motions, label, rays, r, k, starts, steps)
            # Where a pixel has no other surface, several of its depths are the first one again.
            first = _row_of(inverse, 0, r, columns)
            for d in range(len(inverse)):
                depths = _row_of(inverse, d, r, columns)
                _project(starts, steps, depths, place)
                for c in range(columns):
                    if d > 0 and depths[c] == first[c]:
                        seen[k, d, r, c] = seen[k, 0, r, c]
                        for i in range(3):
                            colour[k, i, d, r, c] = colour[k, i, 0, r, c]
                        continue
                    is_seen, pixel, down, right = corner(size, place[0, c], place[1, c])
                    if is_seen:
                        weights = weights_of(down, right)
                        hiding = depths[c] * place[2, c] * (_ONE + share) + per_m
                        asks_moving = has_moving and label[r, c] == 0
                        is_seen = shows(image, pixel * beside, beside, below, weights, hiding, asks_moving)
                    found = bicubic(image, size, pixel, down, right) if is_seen else (_ZERO, _ZERO, _ZERO)
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
    count, has_moving, is_open = len(chosen), size[2] > MOVING, _open_pixels(images, size, chosen)
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
                    is_inside, pixel, down, right = corner(size, place[k, 0, c], place[k, 1, c])
                    is_seen[k] = False
                    if is_inside:
                        at, weights = pixel * beside, weights_of(down, right)
                        hiding = depths[c] * place[k, 2, c] * (_ONE + share) + per_m
                        is_seen[k] = is_open[k, pixel] or shows(
                            image, at, beside, below, weights, hiding, asks_moving
                        )
                        for i in range(3):
                            found[k, i] = between(image, at, beside, below, np.uint64(i), weights)
                _compare(found, is_seen, unseen, weight, agreed[d, r, c], colour[d, r, c])


@njit(inline="always")
def _compare(found, is_seen, unseen, weight, agreed, colour):  # type: ignore[no-untyped-def]
    """Write the agreement (6,) and the weighted mean colour (3,) of a point's colours (k, 3)."""
    seen, whole = _ZERO, _ZERO
    red, green, blue, r, g, b = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
    for k in range(len(found)):
        if is_seen[k]:
            seen += _ONE
            whole += weight[k]
            red, green, blue = red + found[k, 0], green + found[k, 1], blue + found[k, 2]
            r, g, b = r + weight[k] * found[k, 0], g + weight[k] * found[k, 1], b + weight[k] * found[k, 2]
    if seen > _HALF:
        red, green, blue = red / seen, green / seen, blue / seen
    spread = _ZERO
    for k in range(len(found)):
        if is_seen[k]:
            spread += _THIRD * (abs(found[k, 0] - red) + abs(found[k, 1] - green) + abs(found[k, 2] - blue))
    spread = spread / seen if seen > np.float32(1.5) else unseen
    pair = spread
    if len(found) > 1:
        pair = unseen
        if is_seen[0] and is_seen[1]:
            pair = _ZERO
            for i in range(3):
                pair += _THIRD * abs(found[0, i] - found[1, i])
    agreed[0], agreed[1], agreed[2] = spread, pair, seen / np.float32(len(found))
    agreed[3], agreed[4], agreed[5] = red, green, blue
    whole = max(whole, np.float32(1e-6))
    colour[0], colour[1], colour[2] = r / whole, g / whole, b / whole


@njit(cache=True, nogil=True)
def _differ(  # type: ignore[no-untyped-def]
    images, size, chosen, motions, rays, label, inverse, share, per_m, own, unseen, found
):
    rows, columns, _ = rays.shape
    beside, below = np.uint64(size[2]), np.uint64(size[1] * size[2])
    count, has_moving = len(chosen), size[2] > MOVING
    asked = _asked_pixels(inverse)
    # To find the open pixels of whole images takes longer than to ask for few.
    has_open = asked.sum() * _FEW > size[0] * size[1]
    is_open = _open_pixels(images, size, chosen if has_open else chosen[:0])
    starts = np.empty((count, 3, columns), np.float32)
    steps, place = np.empty_like(starts), np.empty_like(starts)
    apart = np.empty(count, np.float32)
    for r in range(rows):
        if not asked[r].any():
            found[:, r] = _ZERO
            continue
        for k in range(count):
            _starts(motions, label, rays, r, k, starts[k], steps[k])
        for d in range(len(inverse)):
            depths = inverse[d, r]
            for k in range(count):
                _project(starts[k], steps[k], depths, place[k])
            for c in range(columns):
                if not asked[r, c] or (d > 0 and depths[c] == inverse[0, r, c]):
                    found[d, r, c] = found[0, r, c] if asked[r, c] else _ZERO
                    continue
                seen = 0
                for k in range(count if depths[c] > _ZERO else 0):
                    image = images[chosen[k]]
                    is_inside, pixel, down, right = corner(size, place[k, 0, c], place[k, 1, c])
                    if not is_inside:
                        continue
                    at, weights = pixel * beside, weights_of(down, right)
                    hiding = depths[c] * place[k, 2, c] * (_ONE + share) + per_m
                    if (has_open and is_open[k, pixel]) or shows(
                        image, at, beside, below, weights, hiding, has_moving and label[r, c] == 0
                    ):
                        total = _ZERO
                        for i in range(3):
                            there = between(image, at, beside, below, np.uint64(i), weights)
                            total += abs(there - own[r, c, i])
                        _insert(apart, seen, min(total * _THIRD, unseen))
                        seen += 1
                half, total = (seen + 1) // 2, _ZERO
                for k in range(half):
                    total += apart[k]
                found[d, r, c] = total / np.float32(half) if half > 0 else unseen


@njit(cache=True, nogil=True)
def _asked_pixels(inverse):  # type: ignore[no-untyped-def]
    """(h, w) bool: pixels whose depths (d, h, w) are not all equal."""
    asked = np.zeros(inverse.shape[1:], np.bool_)
    for r in range(len(asked)):
        here, first = asked[r], inverse[0, r]
        for d in range(1, len(inverse)):
            other = inverse[d, r]
            for c in range(len(here)):
                here[c] |= other[c] != first[c]
    return asked


@njit(inline="always")
def _insert(ascending, count, value):  # type: ignore[no-untyped-def]
    """Insert a value among the first `count` of a list in ascending order."""
    k = count
    while k > 0 and ascending[k - 1] > value:
        ascending[k] = ascending[k - 1]
        k -= 1
    ascending[k] = value
