"""Returns onto a grid: the nearest one of a cell is kept."""

import numpy as np

from nvsf_core.errors import DataError, ShapeError

__all__ = ["nearest_in_cells", "project_nearest"]


def nearest_in_cells(cell: np.ndarray, range_m: np.ndarray, cell_count: int) -> np.ndarray:
    """Index of the nearest return of each cell, -1 where there is none.

    Args:
        cell: (N,) integer cells in [0, cell_count).
        range_m: (N,) finite ranges in metres.
        cell_count: Number of cells.

    Returns:
        (cell_count,) int64 indices into the returns; of equally near ones the first in the list.

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
    # Written from the last to the first, so that the first of equals stays.
    index[cell[winner[::-1]]] = winner[::-1]
    return index


def project_nearest(
    row: np.ndarray, column: np.ndarray, range_m: np.ndarray, value: np.ndarray, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Range image and value image (H, W) float32 of returns, nearest wins, 0.0 = empty.

    Args:
        row: (N,) integer rows; returns outside the grid must have been left out.
        column: (N,) integer columns.
        range_m: (N,) ranges in metres.
        value: (N,) what else to keep of the nearest return, for example its intensity.
        shape: (H, W).
    """
    height, width = shape
    index = nearest_in_cells(row * width + column, range_m, height * width)
    filled = index >= 0
    images = np.zeros((2, height * width), np.float32)
    images[0, filled] = range_m[index[filled]]
    images[1, filled] = value[index[filled]]
    return images[0].reshape(shape), images[1].reshape(shape)
