"""Points projected into an image by a z-buffer, without those hidden by a nearer surface, in numba.

Where in its pixel a point lies is kept, too: on a slanted surface depth changes within a pixel.

A point hides what lies behind it within a small disc of the world, `radius_m`: between the returns of
one wall there are gaps of pixels through which the returns behind it would otherwise be seen.
"""

import math

import numpy as np
from numba import njit

_LARGEST_FOOTPRINT_PX = 12
_NEAR_M = 0.5
_MARGIN_M, _MARGIN_SHARE = 0.3, 0.05
"""A surface's own thickness, and its thickness as a share of the depth: it may be seen at a grazing angle."""
_SAME_SHARE = 0.03
"""Points of a pixel that are farther than its nearest one by at most this share are of the same surface."""


def splat_depth(
    points_m: np.ndarray,
    world_to_camera: np.ndarray,
    intrinsics: tuple[float, float, float, float],
    shape: tuple[int, int],
    radius_m: float = 0.08,
) -> np.ndarray:
    """Depth of the nearest visible point in each pixel.

    Points nearer than 0.5 m are left out. A point of depth z is hidden where a point of depth z' with
    z > z' + 0.3 m + 0.05 z' covers its pixel with a square of half side fx radius_m / z', at most 12 pixels.

    Args:
        points_m: (M, 3) float32, in the frame that `world_to_camera` maps from.
        world_to_camera: (4, 4); camera x right, y down, z forward.
        intrinsics: fx, fy, cx, cy in pixels; pixel centres at integers.
        shape: Rows and columns of the image.
        radius_m: Half side of what a point hides, metres.

    Returns:
        (H, W) float32 depth along z in metres; inf where no point is seen.
    """
    nearest = np.full(shape, np.inf, np.float32)
    _nearest(_in_image(points_m, world_to_camera, intrinsics), nearest)
    # Hiding needs only each pixel's nearest point: what that hides, the ones behind it need not.
    cover = np.full_like(nearest, np.inf)
    _cover(nearest, cover, intrinsics[0] * radius_m)
    return np.where(nearest <= cover, nearest, np.float32(np.inf))


def mean_places(
    points_m: np.ndarray,
    world_to_camera: np.ndarray,
    intrinsics: tuple[float, float, float, float],
    depth_m: np.ndarray,
) -> np.ndarray:
    """Where in its pixel a surface was hit, and its inverse depth there: the mean of the pixel's points.

    Of pixels without a depth, because all their points count as hidden, all points are used: they may belong
    to the surface that is seen beside.

    Args:
        points_m: As of `splat_depth`.
        world_to_camera: As of `splat_depth`.
        intrinsics: As of `splat_depth`.
        depth_m: (H, W) float32, what `splat_depth` gives for these.

    Returns:
        (H, W, 4) float32: number of the points, their mean column and row, their mean inverse depth, 1/m; 0
        without points.
    """
    found = np.zeros((*depth_m.shape, 4), np.float32)
    _add(_in_image(points_m, world_to_camera, intrinsics), depth_m, found)
    found[..., 1:] /= np.maximum(found[..., :1], 1.0)
    return found


def _in_image(
    points_m: np.ndarray, world_to_camera: np.ndarray, intrinsics: tuple[float, float, float, float]
) -> np.ndarray:
    motion = np.ascontiguousarray(world_to_camera[:3], np.float32)
    return _project(np.ascontiguousarray(points_m, np.float32), motion, *intrinsics)


@njit(cache=True, nogil=True)
def _add(image, depth_m, found):  # type: ignore[no-untyped-def]
    """Add up column, row and inverse depth of the points (M, 3) that pixels of a known depth show."""
    rows, columns = depth_m.shape
    for i in range(len(image)):
        u, v, depth = image[i]
        row, column = _pixel(u, v, depth, rows, columns)
        if row >= 0 and depth <= depth_m[row, column] * (1.0 + _SAME_SHARE):
            one = found[row, column]
            one[0], one[1], one[2], one[3] = one[0] + 1.0, one[1] + u, one[2] + v, one[3] + 1.0 / depth


@njit(inline="always")
def _pixel(u, v, depth, rows, columns):  # type: ignore[no-untyped-def]
    """Row and column of a projected point; -1, -1 if the image does not have it."""
    if not (depth < np.inf and u >= -0.5 and u < columns - 0.5 and v >= -0.5 and v < rows - 0.5):
        return -1, -1
    return math.floor(v + 0.5), math.floor(u + 0.5)


@njit(cache=True, nogil=True)
def _project(points, motion, fx, fy, cx, cy):  # type: ignore[no-untyped-def]
    """(M, 3) float32: u, v, depth; depth inf where the point is too near or not finite."""
    image = np.empty_like(points)
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        depth = motion[2, 0] * x + motion[2, 1] * y + motion[2, 2] * z + motion[2, 3]
        if not depth > _NEAR_M:
            image[i, 2] = np.inf
            continue
        right = motion[0, 0] * x + motion[0, 1] * y + motion[0, 2] * z + motion[0, 3]
        down = motion[1, 0] * x + motion[1, 1] * y + motion[1, 2] * z + motion[1, 3]
        image[i, 0] = fx * right / depth + cx
        image[i, 1] = fy * down / depth + cy
        image[i, 2] = depth
    return image


@njit(cache=True, nogil=True)
def _nearest(image, nearest):  # type: ignore[no-untyped-def]
    rows, columns = nearest.shape
    for i in range(image.shape[0]):
        u, v, depth = image[i]
        row, column = _pixel(u, v, depth, rows, columns)
        if row >= 0 and depth < nearest[row, column]:
            nearest[row, column] = depth


@njit(cache=True, nogil=True)
def _cover(nearest, cover, radius_px_m):  # type: ignore[no-untyped-def]
    """Depth behind which each pixel is hidden, by the squares of the pixels around it."""
    rows, columns = nearest.shape
    half, limit = np.empty(columns, np.int64), np.empty(columns, np.float32)
    rim, nothing = _LARGEST_FOOTPRINT_PX, np.float32(np.inf)
    # Of a row, the pixels with equally large squares; and the least depth behind which these hide.
    own, hidden = np.empty(columns + 2 * rim, np.float32), np.empty(columns, np.float32)
    for row in range(rows):
        largest = -1
        for c in range(columns):
            depth = nearest[row, c]
            half[c] = min(int(radius_px_m / depth), rim) if depth < np.inf else -1
            limit[c] = depth + _MARGIN_M + _MARGIN_SHARE * depth
            largest = max(largest, half[c])
        for size in range(largest + 1):
            own[:], hidden[:], found = nothing, nothing, False
            for c in range(columns):
                if half[c] == size:
                    own[c + rim], found = limit[c], True
            # Along the row first, then across: each loop is computed many pixels at a time.
            for shift in range(rim - size, rim + size + 1 if found else 0):
                beside = own[shift : shift + columns]
                for c in range(columns):
                    hidden[c] = min(hidden[c], beside[c])
            for r in range(max(row - size, 0), min(row + size + 1, rows) if found else 0):
                to = cover[r]
                for c in range(columns):
                    to[c] = min(to[c], hidden[c])
