"""The papers' pano: a range image with rows evenly spaced in elevation and columns in azimuth.

Row j looks at elevation fov_up - j fov / H, column i at azimuth -(i - W/2) 2 pi / W. Cell centres are at
whole numbers, row 0 at the upper edge of the field of view, column 0 behind the car.
"""

from dataclasses import dataclass

import numpy as np

from nvsf_core.errors import DataError, ShapeError


@dataclass(frozen=True, slots=True)
class LinearPano:
    """The grid of such a pano, with the sensor's centre as its viewpoint."""

    height: int = 66
    width: int = 1030
    fov_up_deg: float = 2.0
    """Elevation of row 0."""
    fov_deg: float = 26.9
    """Elevation that `height` rows span, downwards."""
    max_range_m: float = 80.0
    """Returns at or beyond it are dropped."""
    reference_quirks: bool = False
    """True as in the papers' code: returns that round to column W are dropped; else they wrap to column 0."""

    def project(self, points_m: np.ndarray, intensity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Images (H, W) float32 of range in metres and of intensity; 0.0 = empty.

        column = round((pi - azimuth) / (2 pi / W)), row = round(H - (elevation + fov_down) / (fov / H)),
        halves to the even number. Points outside the rows, and at the sensor's very centre, are dropped; each
        cell keeps its nearest return.

        Args:
            points_m: (N, 3) in the sensor's frame.
            intensity: (N,) 0..1.

        Raises:
            ShapeError: The arrays are not (N, 3) and (N,).
            DataError: A coordinate is not finite.
        """
        row, column, range_m, kept = self.cells(points_m)
        if intensity.shape != range_m.shape:
            raise ShapeError(f"expected one intensity a point, found {intensity.shape} for {points_m.shape}")
        shape = (self.height, self.width)
        return project_nearest(row[kept], column[kept], range_m[kept], intensity[kept], shape)

    def cells(self, points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Row (N,), column (N,), range (N,) in metres and whether it is kept (N,), of points (N, 3)."""
        if points_m.ndim != 2 or points_m.shape[1] != 3:
            raise ShapeError(f"expected points (N, 3), found {points_m.shape}")
        x, y, z = points_m.astype(np.float64).T
        range_m = np.sqrt(x * x + y * y + z * z)
        if not np.isfinite(range_m).all():
            count = int((~np.isfinite(range_m)).sum())
            raise DataError(f"expected finite points, found {count} of {len(x)} not finite; drop them first")
        row, column, kept = self.cells_towards(np.arctan2(y, x), np.arctan2(z, np.sqrt(x * x + y * y)))
        return row, column, range_m, kept & (range_m > 0.0) & (range_m < self.max_range_m)

    def cells_towards(
        self, azimuth_rad: np.ndarray, elevation_rad: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Row (N,), column (N,) and whether the cell exists (N,), for directions (N,) from the sensor."""
        fov_rad = np.deg2rad(self.fov_deg)
        fov_down_rad = np.deg2rad(self.fov_deg - self.fov_up_deg)
        column = np.rint((np.pi - azimuth_rad) / (2.0 * np.pi / self.width)).astype(np.int64)
        row = np.rint(self.height - (elevation_rad + fov_down_rad) / (fov_rad / self.height)).astype(np.int64)
        kept = (row >= 0) & (row < self.height)
        if self.reference_quirks:
            kept &= column < self.width
        else:
            column %= self.width
        return row, column, kept

    def directions(self, turn_up_rad: float = 0.0) -> np.ndarray:
        """Unit directions (H, W, 3) float64 of the cells' centres, in the sensor's frame.

        They are turned up by `turn_up_rad`, as `sweep_rays` turns a sensor's rays: recorded elevations may
        be too low by an angle.
        """
        elevation = np.deg2rad(self.fov_up_deg - np.arange(self.height) / self.height * self.fov_deg)[:, None]
        elevation = elevation + turn_up_rad
        azimuth = (-(np.arange(self.width) - self.width / 2) / self.width * 2.0 * np.pi)[None, :]
        up = np.broadcast_to(np.sin(elevation), (self.height, self.width))
        return np.stack(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), up], axis=-1
        )

    def points(self, range_m: np.ndarray) -> np.ndarray:
        """Points (N, 3) float64, sensor's frame, of the filled cells of a range image (H, W), row by row.

        Raises:
            ShapeError: The image has another size.
        """
        if range_m.shape != (self.height, self.width):
            raise ShapeError(f"expected a range image {(self.height, self.width)}, found {range_m.shape}")
        filled = range_m > 0.0
        return self.directions()[filled] * range_m[filled, None].astype(np.float64)


def nearest_in_cells(cell: np.ndarray, range_m: np.ndarray, cell_count: int) -> np.ndarray:
    """Index (cell_count,) int64 of the nearest return of each cell, the first of equal ones, -1 = none.

    Of cells (N,) in [0, cell_count) and finite ranges (N,), metres.

    Raises:
        ShapeError: The two arrays differ in length.
        DataError: A range is not finite: it would empty its whole cell.
    """
    if cell.shape != range_m.shape or cell.ndim != 1:
        raise ShapeError(f"expected cell and range_m (N,) alike, found {cell.shape} and {range_m.shape}")
    if not np.isfinite(range_m).all():
        broken = int(np.count_nonzero(~np.isfinite(range_m)))
        raise DataError(
            f"nearest_in_cells: {broken} of {len(range_m)} ranges are not finite; leave those returns out"
        )
    nearest_m = np.full(cell_count, np.inf)
    np.minimum.at(nearest_m, cell, range_m.astype(np.float64))
    winner = np.flatnonzero(nearest_m[cell] == range_m)
    index = np.full(cell_count, -1, np.int64)
    # Written from the last to the first, so that the first of equals remains.
    index[cell[winner[::-1]]] = winner[::-1]
    return index


def project_nearest(
    row: np.ndarray, column: np.ndarray, range_m: np.ndarray, value: np.ndarray, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Range image and value image (H, W) float32 of returns, nearest wins, 0.0 = empty.

    Args:
        row: (N,) int rows, all within the grid.
        column: (N,) int columns, likewise.
        range_m: (N,) ranges in metres.
        value: (N,) another value of each return, for example its intensity.
        shape: (H, W).
    """
    height, width = shape
    index = nearest_in_cells(row * width + column, range_m, height * width)
    filled = index >= 0
    images = np.zeros((2, height * width), np.float32)
    images[0, filled] = range_m[index[filled]]
    images[1, filled] = value[index[filled]]
    return images[0].reshape(shape), images[1].reshape(shape)
