"""By how much what a source image shows lies beside where a view's depth and the poses put it, in numba.

An inverse depth q that is wrong by e moves what source k shows by about e b_k, with b_k the derivative of
its place by q: images before and after a view move apart. Errors of poses move each image alone. What the
images show is therefore first brought to one picture, by local least squares (Lucas and Kanade 1981), and
this picture to where q + e has it, with e fitted to all images' shifts (ridge regression). What is moved
so is then read once more, in the source itself at the moved place: reading twice blurs.
"""

import numpy as np
from numba import njit

from nvsf_core.kernels.images.first_blend import first_blend, luma
from nvsf_core.kernels.images.interpolation import MOVING, SHOWN, between, bicubic, corner, weights_of
from nvsf_core.kernels.images.source_lookup import NEAREST_Z, OUTSIDE, LookUp, shows
from nvsf_core.kernels.images.window_mean import window_mean

_REACH = 5
"""A pixel's shift is that of the window of so many pixels on each side."""
_ROUNDS = 2
"""So often shifts are found anew, from colours that are shifted already."""
_STIFFNESS = np.float32(5e-5)
"""Squared gradient, by pixel, of a window that shifts half as far as differences ask for."""
_UNLIKE = np.float32(0.1)
"""A pixel of this difference has half of the weight: it shows something else."""
_MOST_PX = np.float32(2.0)
"""No shift is longer: depths and poses are nearly right."""
_RIDGE = np.float32(0.1)
"""By what share of the fit's weight an error of the depth is drawn to 0: few images, or all on one side of
the view, tell little about it."""
_U0 = np.uint64(0)
_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
"""With a Python number, or an integer, numba would compute in double precision."""


def brought_together(
    where: LookUp, likeliest: np.ndarray, colour: np.ndarray, seen: np.ndarray, around: np.ndarray,
    weight: np.ndarray, sharpness: float = 0.0,
) -> np.ndarray:  # fmt: skip
    """Colours of source images, each moved to where all of them together have what a pixel shows.

    Shifts are found from the colours at each pixel's likeliest depth, and move those at all its depths.
    A moved colour is the mean of two: what the source shows at the pixels around, each at its own depth,
    between which single pixels of a wrong depth vanish; and what it has at the moved place, which is sharper.
    Of a view of full sharpness it is the latter alone.

    Args:
        where: k source images, and the d points of each pixel of a view of at least 2 x 2 pixels: its rays
            are those of neighbouring pixels, its inverse depths (d, h, w).
        likeliest: (h, w) int64, which of the d is the likeliest.
        colour: (k, 3, d, h, w) float32 that the sources show there, 0..1.
        seen: (k, d, h, w) bool, whether they do.
        around: (3, h, w) float32 colours where no source shows anything.
        weight: (k,) float32 of the sources; 1 = of the nearest.
        sharpness: Of the view, 0..1.

    Returns:
        (k, 3, d, h, w) float32, bicubic, about 0..1; 0 where the source does not show the point.
    """
    blend, shown, is_shown = first_blend(colour, seen, likeliest, around, weight)
    target, shift = luma(blend), np.zeros((*is_shown.shape, 2), np.float32)
    for k in range(len(shown)):
        _align(target, np.where(is_shown[k], luma(shown[k]), target), is_shown[k], shift[k])
    _fit_depth(where.motions, where.rays, where.label, where.inverse, likeliest, is_shown, weight, shift)
    again = np.float32(0.5 + 0.5 * sharpness)
    moved, filled = np.empty_like(colour), np.empty((*around.shape[1:], 4), np.float32)
    for k in range(len(colour)):
        for d in range(colour.shape[2]):
            _fill(colour[k, :, d], seen[k, d], around, filled)
            _move(where, k, d, filled.reshape(-1), filled.shape, seen[k], shift[k], again, moved[k])
    return moved


@njit(cache=True, nogil=True)
def _align(target, shown, seen, shift):  # type: ignore[no-untyped-def]
    """Write the shifts (h, w, 2) by which `shown` (h, w) resembles `target` (h, w) most."""
    rows, columns = target.shape
    size, flat, beside, below = (rows, columns, 1), shown.reshape(-1), np.uint64(1), np.uint64(columns)
    moved, mean = np.empty_like(target), np.empty_like(target)
    sums = np.empty((5, rows, columns), np.float32)
    for _ in range(_ROUNDS):
        for r in range(rows):
            for c in range(columns):
                u, v = np.float32(c) + shift[r, c, 0], np.float32(r) + shift[r, c, 1]
                pixel, along, across = _inside(size, u, v)
                moved[r, c] = between(flat, pixel, beside, below, _U0, weights_of(along, across))
                mean[r, c] = _HALF * (moved[r, c] + target[r, c])
        for r in range(rows):
            upper, lower = mean[max(r - 1, 0)], mean[min(r + 1, rows - 1)]
            for c in range(columns):
                difference = moved[r, c] - target[r, c]
                unlike = difference / _UNLIKE
                trust = _ONE / (_ONE + unlike * unlike) if seen[r, c] else _ZERO
                x = _HALF * (mean[r, min(c + 1, columns - 1)] - mean[r, max(c - 1, 0)])
                y = _HALF * (lower[c] - upper[c])
                sums[0, r, c], sums[1, r, c], sums[2, r, c] = trust * x * x, trust * x * y, trust * y * y
                sums[3, r, c], sums[4, r, c] = trust * x * difference, trust * y * difference
        for i in range(5):
            window_mean(sums[i], _REACH)
        for r in range(rows):
            for c in range(columns):
                xx, xy, yy = sums[0, r, c] + _STIFFNESS, sums[1, r, c], sums[2, r, c] + _STIFFNESS
                whole = xx * yy - xy * xy
                right = shift[r, c, 0] - (yy * sums[3, r, c] - xy * sums[4, r, c]) / whole
                down = shift[r, c, 1] - (xx * sums[4, r, c] - xy * sums[3, r, c]) / whole
                shift[r, c, 0], shift[r, c, 1] = _shortened(right, down)


@njit(inline="always")
def _shortened(right, down):  # type: ignore[no-untyped-def]
    """A shift of the same direction that is not too long."""
    length = np.sqrt(right * right + down * down)
    share = min(_ONE, _MOST_PX / max(length, _MOST_PX))
    return right * share, down * share


@njit(inline="always")
def _inside(size, u, v):  # type: ignore[no-untyped-def]
    """The upper left of the four pixels around a place, and the rests; beyond the border, of the border."""
    rows, columns, _ = size
    u, v = min(max(u, _ZERO), np.float32(columns - 1)), min(max(v, _ZERO), np.float32(rows - 1))
    _, pixel, down, right = corner(size, u, v)
    return pixel, down, right


@njit(cache=True, nogil=True)
def _fit_depth(motions, rays, label, inverse, likeliest, seen, weight, shift):  # type: ignore[no-untyped-def]
    """Replace shifts (k, h, w, 2) to the first blend by those to where a pixel's fitted depth has it."""
    count, rows, columns = seen.shape
    moves = np.empty((count, 2), np.float32)
    for r in range(rows):
        for c in range(columns):
            q = inverse[likeliest[r, c], r, c]
            whole, slope, energy = _ZERO, _ZERO, _ZERO
            right, down, moves_right, moves_down = _ZERO, _ZERO, _ZERO, _ZERO
            for k in range(count):
                w = weight[k] if seen[k, r, c] else _ZERO
                moves[k] = _ZERO
                if w > _ZERO:
                    moves[k, 0], moves[k, 1] = _moves(motions[label[r, c], k], rays[r, c], q)
                whole += w
                right, down = right + w * shift[k, r, c, 0], down + w * shift[k, r, c, 1]
                moves_right, moves_down = moves_right + w * moves[k, 0], moves_down + w * moves[k, 1]
            if whole <= _ZERO:
                continue
            right, down = right / whole, down / whole
            moves_right, moves_down = moves_right / whole, moves_down / whole
            for k in range(count):
                w = weight[k] if seen[k, r, c] else _ZERO
                x, y = moves[k, 0] - moves_right, moves[k, 1] - moves_down
                slope += w * (x * (shift[k, r, c, 0] - right) + y * (shift[k, r, c, 1] - down))
                energy += w * (x * x + y * y + _RIDGE * (moves[k, 0] ** 2 + moves[k, 1] ** 2))
            error = slope / energy if energy > _ZERO else _ZERO
            right, down = _shortened(right - error * moves_right, down - error * moves_down)
            for k in range(count):
                shift[k, r, c, 0] -= right
                shift[k, r, c, 1] -= down


@njit(inline="always")
def _moves(motion, ray, inverse):  # type: ignore[no-untyped-def]
    """How fast a source's place of a pixel moves with its inverse depth, in the view's pixels."""
    x = motion[0, 0] * ray[0] + motion[0, 1] * ray[1] + motion[0, 2] + inverse * motion[0, 3]
    y = motion[1, 0] * ray[0] + motion[1, 1] * ray[1] + motion[1, 2] + inverse * motion[1, 3]
    z = motion[2, 0] * ray[0] + motion[2, 1] * ray[1] + motion[2, 2] + inverse * motion[2, 3]
    z = max(z, NEAREST_Z)
    # By how much larger the source shows things than the view cancels the division by z.
    return motion[0, 3] - motion[2, 3] * x / z, motion[1, 3] - motion[2, 3] * y / z


@njit(cache=True, nogil=True)
def _fill(colour, seen, around, filled):  # type: ignore[no-untyped-def]
    """Write (h, w, 4): a source's colours (3, h, w), or those around, and whether it shows the point."""
    for r in range(seen.shape[0]):
        for c in range(seen.shape[1]):
            is_seen = seen[r, c]
            for i in range(3):
                filled[r, c, i] = colour[i, r, c] if is_seen else around[i, r, c]
            filled[r, c, SHOWN] = _ONE if is_seen else _ZERO


@njit(cache=True, nogil=True)
def _move(where, k, d, filled, size, seen, shift, again, moved):  # type: ignore[no-untyped-def]
    """Write the colours (3, d, h, w) of source k beside all pixels that it shows at depth d; 0 for others.

    Each is a mean of what it shows there, moved, and, with the weight `again`, of what it has at the moved
    place. `filled` and `size` are its colours at that depth as of `_fill`, flat, and their shape; `seen` (d,
    h, w) bool, `shift` (h, w, 2) in pixels. Depth 0 is written first.
    """
    image = where.images[where.chosen[k]]
    pixels, channels = image.reshape(-1), image.shape[2]
    beside, below = np.uint64(channels), np.uint64(image.shape[1] * channels)
    rows, columns = seen.shape[1:]
    for r in range(rows):
        for c in range(columns):
            if not seen[d, r, c]:
                moved[0, d, r, c], moved[1, d, r, c], moved[2, d, r, c] = _ZERO, _ZERO, _ZERO
                continue
            q = where.inverse[d, r, c]
            # Where a pixel has no other surface, its other depths are the first one again.
            if d > 0 and q == where.inverse[0, r, c]:
                for i in range(3):
                    moved[i, d, r, c] = moved[i, 0, r, c]
                continue
            pixel, down, right = _inside(size, np.float32(c) + shift[r, c, 0], np.float32(r) + shift[r, c, 1])
            found = bicubic(filled, size, pixel, down, right)
            motion = where.motions[where.label[r, c], k]
            u, v, scale = _place(motion, where.rays, r, c, shift[r, c], q)
            nearer = q * scale * (_ONE + where.hiding[0]) + where.hiding[1]
            is_inside, pixel, down, right = corner(image.shape, u, v)
            asks_moving = channels > MOVING and where.label[r, c] == 0
            # A place in front of which the source has another surface, or that it lacks, tells nothing.
            if is_inside and shows(
                pixels, pixel * beside, beside, below, weights_of(down, right), nearer, asks_moving
            ):
                there = bicubic(pixels, image.shape, pixel, down, right)
                for i in range(3):
                    moved[i, d, r, c] = (_ONE - again) * found[i] + again * there[i]
            else:
                moved[0, d, r, c], moved[1, d, r, c], moved[2, d, r, c] = found


@njit(inline="always")
def _place(motion, rays, r, c, shift, inverse):  # type: ignore[no-untyped-def]
    """Column, row and 1/z in a source of the point that a view has `shift` pixels beside (r, c).

    It has the inverse depth of the pixel itself. Behind the source the column is far outside.
    """
    x = rays[r, c, 0] + shift[0] * (rays[0, 1, 0] - rays[0, 0, 0])
    y = rays[r, c, 1] + shift[1] * (rays[1, 0, 1] - rays[0, 0, 1])
    z = motion[2, 0] * x + motion[2, 1] * y + motion[2, 2] + inverse * motion[2, 3]
    scale = _ONE / max(z, NEAREST_Z)
    u = (motion[0, 0] * x + motion[0, 1] * y + motion[0, 2] + inverse * motion[0, 3]) * scale
    v = (motion[1, 0] * x + motion[1, 1] * y + motion[1, 2] + inverse * motion[1, 3]) * scale
    return (u if z > NEAREST_Z else OUTSIDE), v, scale
