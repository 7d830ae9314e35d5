"""The ground as a height map, robust to objects on it and to mirrored returns below it."""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

CELL_M = 1.0
_MOST_RETURNS = 1_000_000
_MOST_CELLS = 4_000_000
_PERCENTILE = 0.03
_ABOVE_NEIGHBOURS_M = 0.6
"""A cell that much higher than the lowest within 3 m is not ground but a car's roof or a hedge."""
_MIRRORED_M, _MIRROR_PERCENTILE = 1.5, 25
"""A cell that much lower than the lower quartile within 7 m holds mirror images. It is left out first, so
that its height does not spread."""
_BELOW_NEIGHBOURS_M = 0.7
"""A cell that much lower than the median within 7 m holds mirror images from puddles or car bonnets."""


@dataclass(frozen=True, slots=True, eq=False)
class GroundMap:
    """Height of the ground in square cells of one metre."""

    origin_m: np.ndarray
    """(2,) float64, lower corner in x and y, scene-local metres."""
    height_m: np.ndarray
    """(a, b) float32, scene-local z in metres, by x and y cell."""

    def above(self, point_m: np.ndarray) -> np.ndarray:
        """Heights (N,) float32 metres of scene-local points (N, 3) above the ground of the nearest cell."""
        column = np.floor((point_m[:, :2] - self.origin_m) / CELL_M).astype(np.int32)
        column = np.clip(column, 0, np.array(self.height_m.shape) - 1)
        return (point_m[:, 2] - self.height_m[column[:, 0], column[:, 1]]).astype(np.float32)


def build_ground(point_m: np.ndarray) -> GroundMap:
    """Height map of the ground below at least one return (N, 3), scene-local metres, z up.

    1. Each cell takes the third percentile of its z; it is emptied where that lies 1.5 m below the lower
       quartile of the 15 x 15 cells around.
    2. A cell 0.6 m above the lowest of the 7 x 7 cells around takes that height; empty ones take the nearest.
    3. Each cell takes the median of 3 x 3 cells; 0.7 m below the median of 15 x 15, it takes that median.
    """
    point_m = point_m[:: max(1, len(point_m) // _MOST_RETURNS)]
    # A few returns far off would make the map huge: beyond the extent of nearly all the border holds.
    low, high = np.quantile(point_m[:, :2], [0.0005, 0.9995], axis=0)
    origin = np.floor(low / CELL_M) * CELL_M
    shape = np.maximum(np.ceil((high - origin) / CELL_M).astype(np.int64), 1)
    shape = np.minimum(shape, int(_MOST_CELLS**0.5))
    cell = np.floor((point_m[:, :2] - origin) / CELL_M).astype(np.int64)
    within = np.all((cell >= 0) & (cell < shape), axis=1)
    height = _percentile_by_cell(cell[within, 0] * shape[1] + cell[within, 1], point_m[within, 2], shape)
    low = ndimage.percentile_filter(_filled(height), _MIRROR_PERCENTILE, 15, mode="nearest")
    height[height < low - _MIRRORED_M] = np.inf
    lowest = ndimage.minimum_filter(height, 7, mode="nearest")
    height = np.where(height > lowest + _ABOVE_NEIGHBOURS_M, lowest, height)
    height = _filled(height)
    height = ndimage.median_filter(height, 3, mode="nearest")
    around = ndimage.median_filter(height, 15, mode="nearest")
    height = np.where(height < around - _BELOW_NEIGHBOURS_M, around, height)
    return GroundMap(origin, height.astype(np.float32))


def _percentile_by_cell(cell: np.ndarray, z_m: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Third percentile of z in each cell, infinite where there is none."""
    height = np.full(int(shape.prod()), np.inf)
    order = np.lexsort((z_m, cell))
    ids, first, count = np.unique(cell[order], return_index=True, return_counts=True)
    height[ids] = z_m[order][first + (_PERCENTILE * count).astype(np.int64)]
    return height.reshape(shape)


def _filled(height: np.ndarray) -> np.ndarray:
    """Infinite cells take the nearest finite cell's height."""
    nearest = ndimage.distance_transform_edt(
        ~np.isfinite(height), return_distances=False, return_indices=True
    )
    return height[tuple(nearest)]
