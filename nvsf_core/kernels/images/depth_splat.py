"""Depth maps of images carried into another view, and the surface that most of them agree on, in numba.

All depths are inverse depths along z, 1/m; 0 = unknown. A depth map has the size of its image.
"""

import math

import numpy as np
from numba import njit

_NEAR_M = 0.3
"""Points nearer to the view are not carried."""
_LARGEST_FOOTPRINT_PX = 6.0
_FOOTPRINT = 1.2
"""Side of the square that a pixel covers in the view, in pixels of its own size there: no cracks between."""
_AGREE_SHARE, _AGREE_PER_M, _ZERO = np.float32(0.03), np.float32(0.002), np.float32(0.0)
"""Two inverse depths agree within this share of the nearer one plus so much, 1/m."""
_NEAREST, _HALF = 3, np.float32(0.5)
"""A moving object needs as much as half of the weight of so many maps, the nearest to it."""
_EDGE = 0.25
"""An inverse depth that changes by a larger share to a neighbour lies on an edge."""


def without_edges(inverse: np.ndarray) -> np.ndarray:
    """A depth map (H, W) float32, 1/m, without the pixels at depth edges: they mix two surfaces."""
    kept = inverse.copy()
    for axis in (0, 1):
        first = inverse[:-1] if axis == 0 else inverse[:, :-1]
        second = inverse[1:] if axis == 0 else inverse[:, 1:]
        jumps = np.abs(first - second) > _EDGE * np.maximum(first, second)
        (kept[:-1] if axis == 0 else kept[:, :-1])[jumps] = 0.0
        (kept[1:] if axis == 0 else kept[:, 1:])[jumps] = 0.0
    return kept


def splat_depth_map(
    inverse: np.ndarray, label: np.ndarray, motion: np.ndarray, intrinsics: tuple[float, float, float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """The front surface of one image's depth map, as a view with the same intrinsics sees it.

    Args:
        inverse: (H, W) float32, 1/m, of the image.
        label: (H, W) uint8: what each pixel shows, an index of `motion`.
        motion: (o, 4, 4) from the image's camera frame to the view's: of what is static, and of each moving
            object. With zeros the pixels of that label are left out.
        intrinsics: fx, fy, cx, cy in pixels; pixel centres at integers.

    Returns:
        (H, W) float32, 1/m, of the view, 0 where the image shows nothing; and its labels (H, W) uint8.
    """
    view, labels = np.zeros_like(inverse, np.float32), np.zeros_like(label, np.uint8)
    motions = np.ascontiguousarray(motion[:, :3], np.float64)
    _splat(np.ascontiguousarray(inverse, np.float32), label, motions, *intrinsics, view, labels)
    return view, labels


def agreed_depths(
    inverse: np.ndarray, label: np.ndarray, weight: np.ndarray, least_share: float, expected: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The nearest surface on which enough of n depth maps of a view agree, and the best supported other one.

    A single map's errors lie at other places than another's: a depth that only one of several gives is passed
    over for the next one behind it. Where no surface has enough support, the best supported one is taken.
    Maps that show what is static say little about a moving object, which was elsewhere at their instants: it
    has enough, too, with half of the weight of the three maps nearest to it.
    Where a moving object is expected and some map shows it, the others say nothing: they show what was there
    at another time.

    Args:
        inverse: (n, H, W) float32, 1/m, each in the view's own pixels.
        label: (n, H, W) uint8: what each pixel of each map shows; unlike ones never agree.
        weight: (m, n) float32, of the maps, for each of the m labels.
        least_share: Enough weight, as a share of the weight of all maps that know the pixel.
        expected: (H, W) uint8: the moving object at a pixel, as a label; 0 = none is known to be there.

    Returns:
        (2, H, W) float32, 1/m, of both surfaces: the weighted mean of those that agree, 0 where none is;
        (2, H, W) float32, the weight of those that agree as a share of that of all n maps for that label; and
        the labels (2, H, W) uint8.
    """
    shape = (2, *inverse.shape[1:])
    depth, support = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    labels = np.zeros(shape, np.uint8)
    _agree(
        np.ascontiguousarray(inverse, np.float32), label, np.ascontiguousarray(weight, np.float32),
        np.float32(least_share), expected, depth, support, labels,
    )  # fmt: skip
    return depth, support, labels


@njit(cache=True, nogil=True)
def _splat(inverse, label, motions, fx, fy, cx, cy, view, labels):  # type: ignore[no-untyped-def]
    rows, columns = inverse.shape
    x = (np.arange(columns) - cx) / fx
    for row in range(rows):
        y = (row - cy) / fy
        for column in range(columns):
            q, own = float(inverse[row, column]), label[row, column]
            if not q > 0.0:
                continue
            motion = motions[own]
            # All of the point (x, y, 1, q): its depth in the view times q, the inverse of that in the image.
            along = motion[2, 0] * x[column] + motion[2, 1] * y + motion[2, 2] + motion[2, 3] * q
            # A motion of zeros puts every point at depth 0.
            if not along > _NEAR_M * q:
                continue
            scale = 1.0 / along
            right = motion[0, 0] * x[column] + motion[0, 1] * y + motion[0, 2] + motion[0, 3] * q
            down = motion[1, 0] * x[column] + motion[1, 1] * y + motion[1, 2] + motion[1, 3] * q
            u, v = fx * right * scale + cx, fy * down * scale + cy
            half = 0.5 * min(_FOOTPRINT * max(1.0, scale), _LARGEST_FOOTPRINT_PX)
            first_row, last_row = max(0, math.ceil(v - half)), min(rows - 1, math.floor(v + half))
            first_column, last_column = max(0, math.ceil(u - half)), min(columns - 1, math.floor(u + half))
            found = np.float32(q * scale)
            for r in range(first_row, last_row + 1):
                for c in range(first_column, last_column + 1):
                    if found > view[r, c]:
                        view[r, c], labels[r, c] = found, own


@njit(cache=True, nogil=True)
def _agree(inverse, label, weight, least_share, expected, depth, support, labels):  # type: ignore[no-untyped-def]
    maps, rows, columns = inverse.shape
    whole = weight.sum(axis=1)
    mass, mean = np.empty(maps, np.float32), np.empty(maps, np.float32)
    enough, of_object = np.empty(maps, np.float32), _enough_of_objects(weight)
    q, what = np.empty(maps, np.float32), np.empty(maps, np.int32)
    for row in range(rows):
        for column in range(columns):
            for i in range(maps):
                q[i], what[i] = inverse[i, row, column], label[i, row, column]
            if expected[row, column] > 0:
                _leave_expected(q, what, expected[row, column])
            total = _agreeing(q, what, weight, mass, mean)
            for i in range(maps):
                enough[i] = min(least_share * total, of_object[what[i]])
            first = _front(q, mass, enough)
            if first < 0:
                continue
            second = -1
            for i in range(maps):
                if mass[i] > 0.0 and not _agrees(q[i], what[i], q[first], what[first]):
                    second = i if second < 0 or mass[i] > mass[second] else second
            for place, i in ((0, first), (1, second)):
                if i >= 0:
                    depth[place, row, column] = mean[i] / mass[i]
                    support[place, row, column] = mass[i] / whole[what[i]]
                    labels[place, row, column] = what[i]


@njit(cache=True, nogil=True)
def _enough_of_objects(weight):  # type: ignore[no-untyped-def]
    """(m,) weight that is enough for each label; infinite for what is static."""
    found = np.empty(len(weight), np.float32)
    found[0] = np.inf
    for m in range(1, len(weight)):
        found[m] = _HALF * np.sort(weight[m])[-_NEAREST:].sum()
    return found


@njit(cache=True, nogil=True)
def _leave_expected(inverse, label, expected):  # type: ignore[no-untyped-def]
    """Forget the inverse depths of a pixel's maps that do not show the object expected there, if one does."""
    shown = False
    for i in range(len(inverse)):
        shown = shown or (inverse[i] > 0.0 and label[i] == expected)
    for i in range(len(inverse)):
        if shown and label[i] != expected:
            inverse[i] = 0.0


@njit(cache=True, nogil=True)
def _front(inverse, mass, enough):  # type: ignore[no-untyped-def]
    """Index of the nearest depth with enough support, else of the best supported one; -1 = there is none."""
    first = -1
    for i in range(len(mass)):
        if mass[i] == 0.0:
            continue
        if first < 0 or (mass[i] >= enough[i] and mass[first] < enough[first]):
            first = i
        elif mass[first] >= enough[first]:
            first = i if mass[i] >= enough[i] and inverse[i] > inverse[first] else first
        elif mass[i] > mass[first]:
            first = i
    return first


@njit(inline="always")
def _agreeing(inverse, label, weight, mass, mean):  # type: ignore[no-untyped-def]
    """Write for each map the weight of all that agree with it at a pixel, and their weighted inverse depths.

    Returns the weight of all maps that know the pixel.
    """
    total = _ZERO
    mass[:], mean[:] = _ZERO, _ZERO
    for j in range(len(inverse)):
        own_q, own_label = inverse[j], label[j]
        if own_q > _ZERO:
            own = weight[own_label, j]
            total += own
            # No branches: this loop is computed several maps at a time.
            for i in range(len(inverse)):
                added = own if _agrees(inverse[i], label[i], own_q, own_label) else _ZERO
                mass[i] += added
                mean[i] += added * own_q
    for i in range(len(inverse)):
        mass[i] = mass[i] if inverse[i] > _ZERO else _ZERO
    return total


@njit(inline="always")
def _agrees(inverse, label, other, other_label):  # type: ignore[no-untyped-def]
    """Whether two maps show the same at a pixel that the other one knows."""
    near = abs(other - inverse) <= _AGREE_SHARE * max(inverse, other) + _AGREE_PER_M
    return near & (label == other_label)
