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
    inverse: np.ndarray, motion: np.ndarray, intrinsics: tuple[float, float, float, float]
) -> np.ndarray:
    """The front surface of one image's depth map, as a view with the same intrinsics sees it.

    Args:
        inverse: (H, W) float32, 1/m, of the image.
        motion: (4, 4) from the image's camera frame to the view's.
        intrinsics: fx, fy, cx, cy in pixels; pixel centres at integers.

    Returns:
        (H, W) float32, 1/m, of the view; 0 where the image shows nothing.
    """
    view = np.zeros_like(inverse, np.float32)
    _splat(
        np.ascontiguousarray(inverse, np.float32), np.ascontiguousarray(motion[:3], np.float64), *intrinsics, view
    )  # fmt: skip
    return view


def agreed_depths(
    inverse: np.ndarray, weight: np.ndarray, least_share: float
) -> tuple[np.ndarray, np.ndarray]:
    """The nearest surface on which enough of n depth maps of one view agree, and the best supported other one.

    A single map's errors lie at other places than another's: a depth that only one of several gives is passed
    over for the next one behind it. Where no surface has enough support, the best supported one is taken.

    Args:
        inverse: (n, H, W) float32, 1/m, each in the view's own pixels.
        weight: (n,) float32, of the maps.
        least_share: Enough weight, as a share of the weight of all maps that know the pixel.

    Returns:
        (2, H, W) float32, 1/m, of both surfaces: the weighted mean of those that agree, 0 where there is none;
        and (2, H, W) float32, the weight of those that agree as a share of the weight of all n maps.
    """
    shape = (2, *inverse.shape[1:])
    depth, support = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    _agree(
        np.ascontiguousarray(inverse, np.float32), np.ascontiguousarray(weight, np.float32),
        np.float32(least_share), depth, support,
    )  # fmt: skip
    return depth, support


@njit(cache=True, nogil=True)
def _splat(inverse, motion, fx, fy, cx, cy, view):  # type: ignore[no-untyped-def]
    rows, columns = inverse.shape
    for row in range(rows):
        for column in range(columns):
            q = inverse[row, column]
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
                        view[r, c] = found


@njit(cache=True, nogil=True)
def _agree(inverse, weight, least_share, depth, support):  # type: ignore[no-untyped-def]
    maps, rows, columns = inverse.shape
    whole = weight.sum()
    for row in range(rows):
        for column in range(columns):
            total = np.float32(0.0)
            for i in range(maps):
                if inverse[i, row, column] > 0.0:
                    total += weight[i]
            if total == 0.0:
                continue
            best, best_sum, best_mass, is_enough = np.float32(0.0), np.float32(0.0), np.float32(0.0), False
            for i in range(maps):
                q = inverse[i, row, column]
                if not q > 0.0 or (is_enough and q <= best):
                    continue
                mass, mean = np.float32(0.0), np.float32(0.0)
                for j in range(maps):
                    other = inverse[j, row, column]
                    if other > 0.0 and abs(other - q) <= _AGREE_SHARE * max(q, other) + _AGREE_PER_M:
                        mass += weight[j]
                        mean += weight[j] * other
                enough = mass >= least_share * total
                # An agreed surface wins over none; among agreed ones the nearest, else the best supported.
                if (enough and (not is_enough or q > best)) or (
                    not enough and not is_enough and mass > best_mass
                ):
                    best, best_sum, best_mass, is_enough = q, mean, mass, enough
            depth[0, row, column] = best_sum / best_mass
            support[0, row, column] = best_mass / whole
            other_sum, other_mass = np.float32(0.0), np.float32(0.0)
            for i in range(maps):
                q = inverse[i, row, column]
                if not q > 0.0 or abs(q - best) <= _AGREE_SHARE * max(q, best) + _AGREE_PER_M:
                    continue
                mass, mean = np.float32(0.0), np.float32(0.0)
                for j in range(maps):
                    other = inverse[j, row, column]
                    if other > 0.0 and abs(other - q) <= _AGREE_SHARE * max(q, other) + _AGREE_PER_M:
                        mass += weight[j]
                        mean += weight[j] * other
                if mass > other_mass:
                    other_sum, other_mass = mean, mass
            if other_mass > 0.0:
                depth[1, row, column] = other_sum / other_mass
                support[1, row, column] = other_mass / whole
