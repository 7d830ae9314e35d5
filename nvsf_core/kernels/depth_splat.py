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
_AGREE_SHARE, _AGREE_PER_M = 0.03, 0.002
"""Two inverse depths agree within this share of the nearer one plus so much, 1/m."""
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
    for row in range(rows):
        for column in range(columns):
            q = inverse[row, column]
            motion = motions[label[row, column]]
            # A motion of zeros puts every point at depth 0.
            if not q > 0.0:
                continue
            x, y, z = (column - cx) / fx / q, (row - cy) / fy / q, 1.0 / q
            depth = motion[2, 0] * x + motion[2, 1] * y + motion[2, 2] * z + motion[2, 3]
            if not depth > _NEAR_M:
                continue
            right = motion[0, 0] * x + motion[0, 1] * y + motion[0, 2] * z + motion[0, 3]
            down = motion[1, 0] * x + motion[1, 1] * y + motion[1, 2] * z + motion[1, 3]
            u, v = fx * right / depth + cx, fy * down / depth + cy
            half = 0.5 * min(_FOOTPRINT * max(1.0, z / depth), _LARGEST_FOOTPRINT_PX)
            first_row, last_row = max(0, math.ceil(v - half)), min(rows - 1, math.floor(v + half))
            first_column, last_column = max(0, math.ceil(u - half)), min(columns - 1, math.floor(u + half))
            found = np.float32(1.0 / depth)
            for r in range(first_row, last_row + 1):
                for c in range(first_column, last_column + 1):
                    if found > view[r, c]:
                        view[r, c], labels[r, c] = found, label[row, column]


@njit(cache=True, nogil=True)
def _agree(inverse, label, weight, least_share, expected, depth, support, labels):  # type: ignore[no-untyped-def]
    maps, rows, columns = inverse.shape
    whole = weight.sum(axis=1)
    mass, mean = np.empty(maps, np.float32), np.empty(maps, np.float32)
    q, what = np.empty(maps, np.float32), np.empty(maps, np.uint8)
    for row in range(rows):
        for column in range(columns):
            q[:], what[:] = inverse[:, row, column], label[:, row, column]
            _leave_expected(q, what, expected[row, column])
            total = np.float32(0.0)
            for i in range(maps):
                mass[i], mean[i] = _agreeing(q, what, weight, i)
                if q[i] > 0.0:
                    total += weight[what[i], i]
            first = _front(q, mass, least_share * total)
            if first < 0:
                continue
            second = -1
            for i in range(maps):
                if mass[i] > 0.0 and not _agrees(q, what, i, first):
                    second = i if second < 0 or mass[i] > mass[second] else second
            for place, i in ((0, first), (1, second)):
                if i >= 0:
                    depth[place, row, column] = mean[i] / mass[i]
                    support[place, row, column] = mass[i] / whole[what[i]]
                    labels[place, row, column] = what[i]


@njit(cache=True, nogil=True)
def _leave_expected(inverse, label, expected):  # type: ignore[no-untyped-def]
    """Forget the inverse depths of a pixel's maps that do not show the object expected there, if one does."""
    shown = False
    for i in range(len(inverse)):
        shown = shown or (inverse[i] > 0.0 and label[i] == expected)
    for i in range(len(inverse)):
        if expected > 0 and shown and label[i] != expected:
            inverse[i] = 0.0


@njit(cache=True, nogil=True)
def _front(inverse, mass, enough):  # type: ignore[no-untyped-def]
    """Index of the nearest depth with enough support, else of the best supported one; -1 = there is none."""
    first = -1
    for i in range(len(mass)):
        if mass[i] == 0.0:
            continue
        if first < 0 or (mass[i] >= enough and mass[first] < enough):
            first = i
        elif mass[first] >= enough:
            first = i if mass[i] >= enough and inverse[i] > inverse[first] else first
        elif mass[i] > mass[first]:
            first = i
    return first


@njit(cache=True, nogil=True)
def _agreeing(inverse, label, weight, i):  # type: ignore[no-untyped-def]
    """Weight of all maps that agree with map i at a pixel, and the weighted sum of their inverse depths."""
    mass, mean = np.float32(0.0), np.float32(0.0)
    if inverse[i] > 0.0:
        for j in range(len(inverse)):
            if _agrees(inverse, label, i, j):
                mass += weight[label[j], j]
                mean += weight[label[j], j] * inverse[j]
    return mass, mean


@njit(cache=True, nogil=True)
def _agrees(inverse, label, i, j):  # type: ignore[no-untyped-def]
    near = abs(inverse[j] - inverse[i]) <= _AGREE_SHARE * max(inverse[i], inverse[j]) + _AGREE_PER_M
    return inverse[j] > 0.0 and near and label[i] == label[j]
