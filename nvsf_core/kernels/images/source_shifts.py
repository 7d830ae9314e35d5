"""By how much what a source image shows lies beside where a view's depth and the poses put it, in numba.

An inverse depth q that is wrong by e moves what source k shows by about e b_k, with b_k the derivative of
its place by q: images before and after a view move apart. Errors of poses move each image alone. What the
images show is therefore first brought to one picture, by local least squares (Lucas and Kanade 1981), and
this picture to where q + e has it, with e fitted to all images' shifts (ridge regression).
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from nvsf_core.kernels.images.first_blend import first_blend, luma
from nvsf_core.kernels.images.interpolation import SHOWN, between, bicubic, corner, weights_of
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
_NEAREST_Z = np.float32(1e-3)
"""Smallest z of a point scaled by its inverse depth; with less it counts as behind the source."""
_U0 = np.uint64(0)
_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
"""With a Python number, or an integer, numba would compute in double precision."""


class Surface(NamedTuple):
    """The pixels of a view or of a window of it, and where k sources show them."""

    motions: np.ndarray
    """(m, k, 3, 4) float32, as of `nvsf_core.kernels.images.source_lookup.LookUp`."""
    rays: np.ndarray
    """(h, w, 3) float32 directions (x, y, 1) of the pixels."""
    label: np.ndarray
    """(h, w) uint8, which of the m motions a pixel has."""
    inverse: np.ndarray
    """(d, h, w) float32 inverse depths, 1/m."""
    likeliest: np.ndarray
    """(h, w) int64, which of the d depths is the likeliest."""


def brought_together(
    surface: Surface, colour: np.ndarray, seen: np.ndarray, around: np.ndarray, weight: np.ndarray
) -> np.ndarray:
    """Colours of source images, each moved to where all of them together have what a pixel shows.

    Shifts are found from the colours at each pixel's likeliest depth, and move those at all its depths.

    Args:
        surface: The pixels, and which of d depths is their likeliest.
        colour: (k, 3, d, h, w) float32 that the sources show there, 0..1.
        seen: (k, d, h, w) bool, whether they do.
        around: (3, h, w) float32 colours where no source shows anything.
        weight: (k,) float32 of the sources; 1 = of the nearest.

    Returns:
        (k, 3, d, h, w) float32, bicubic, about 0..1; 0 where the source does not show the point.
    """
    blend, shown, is_shown = first_blend(colour, seen, surface.likeliest, around, weight)
    target, shift = luma(blend), np.zeros((*is_shown.shape, 2), np.float32)
    for k in range(len(shown)):
        _align(target, np.where(is_shown[k], luma(shown[k]), target), is_shown[k], shift[k])
    _fit_depth(*surface, is_shown, weight, shift)
    moved, filled = np.empty_like(colour), np.empty((*around.shape[1:], 4), np.float32)
    for k in range(len(colour)):
        for d in range(colour.shape[2]):
            _fill(colour[k, :, d], seen[k, d], around, filled)
            _move(filled.reshape(-1), filled.shape, seen[k, d], shift[k], moved[k, :, d])
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
    z = max(z, _NEAREST_Z)
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
def _move(filled, size, seen, shift, moved):  # type: ignore[no-untyped-def]
    """Write the colours (3, h, w) beside all pixels that a source shows; 0 for others."""
    rows, columns = seen.shape
    for r in range(rows):
        for c in range(columns):
            if not seen[r, c]:
                moved[0, r, c], moved[1, r, c], moved[2, r, c] = _ZERO, _ZERO, _ZERO
                continue
            pixel, down, right = _inside(size, np.float32(c) + shift[r, c, 0], np.float32(r) + shift[r, c, 1])
            found = bicubic(filled, size, pixel, down, right)
            moved[0, r, c], moved[1, r, c], moved[2, r, c] = found
