"""A sparse index of the voxels that hold returns, in bricks of 8 x 8 x 8 cells; and how their points scatter.

A voxel is a cell, or a cube of 2, 4 or 8 cells an edge: all voxels of a brick are of one size.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from nvsf_core.errors import DataError

BRICK = 8
"""Cells along each edge of a brick."""
_EMPTY_LEVELS = 3
"""Empty bricks are put together to cubes of 2, 4 and 8 an edge."""


class VoxelIndex(NamedTuple):
    """Numbers the voxels that hold at least one return."""

    origin_m: np.ndarray
    """(3,) float64 metres: lower corner of the grid, scene-local."""
    voxel_m: float
    """Edge of a cell, which is the smallest voxel, metres."""
    bricks: np.ndarray
    """(bx, by, bz) int32: a brick's row in `cells`; of an empty one -1 - k: the cube of 2^k bricks an edge in
    which it lies, if bricks are counted off in such cubes, is empty as a whole."""
    cells: np.ndarray
    """(n_bricks, 512) int32: number of the voxel that a cell is of, or -1."""
    occupied: np.ndarray
    """(n_bricks, 8) uint64, see `occupied_bits`."""
    edges: np.ndarray
    """(n_bricks,) int64: edge of the brick's voxels in cells, 1, 2, 4 or 8."""

    @property
    def voxel_count(self) -> int:
        """Number of voxels that hold a return."""
        return int(self.cells.max(initial=-1)) + 1

    def occupied_cells(self) -> tuple[np.ndarray, np.ndarray]:
        """Grid coordinates (c, 3) int64 of all cells of voxels, and the voxels' numbers (c,) int32."""
        brick = np.argwhere(self.bricks >= 0)
        corner = np.empty_like(brick)
        corner[self.bricks[tuple(brick.T)]] = brick * BRICK
        row, cell = np.nonzero(self.cells >= 0)
        place = corner[row] + np.stack(np.unravel_index(cell, (BRICK,) * 3), axis=1)
        return place, self.cells[row, cell]

    def places(self) -> np.ndarray:
        """(v, 3) int64: grid coordinates of each voxel's lowest cell, counted from the lower corner."""
        place, number = self.occupied_cells()
        found = np.empty((self.voxel_count, 3), np.int64)
        # Backwards: of a voxel's cells the lowest is written last.
        found[number[::-1]] = place[::-1]
        return found

    def edges_of(self, place: np.ndarray) -> np.ndarray:
        """(n,) int64 edges, in cells, of the voxels in whose bricks grid coordinates (n, 3) int lie."""
        return np.asarray(self.edges[self.bricks[tuple((place // BRICK).T)]])

    def find(self, place: np.ndarray) -> np.ndarray:
        """(n,) int32 numbers of the voxels at grid coordinates (n, 3) int; -1 where there is none."""
        inside = np.all((place >= 0) & (place < np.array(self.bricks.shape) * BRICK), axis=1)
        x, y, z = place[inside].T
        row = self.bricks[x // BRICK, y // BRICK, z // BRICK]
        number = self.cells[np.maximum(row, 0), x % BRICK * BRICK**2 + y % BRICK * BRICK + z % BRICK]
        found = np.full(len(place), -1, np.int32)
        found[inside] = np.where(row >= 0, number, -1)
        return found


def occupied_bits(cells: np.ndarray) -> np.ndarray:
    """Which voxels of each brick (n, 512) have a number, as bits (n, 8) uint64; bit 8 y + z of word x.

    They are a 32nd of `cells`: a walk that asks them first finds them in the processor's caches.
    """
    packed = np.packbits(cells >= 0, axis=1, bitorder="little")
    return packed.view("<u8").astype(np.uint64, copy=False)


def index_points(points_m: np.ndarray, voxel_m: float) -> tuple[VoxelIndex, np.ndarray]:
    """The index over points (n, 3), scene-local metres, and the number (n,) int32 of each point's voxel.

    Raises:
        DataError: There are no points, one is not finite, or their box would need more than a gigabyte of
            bricks.
    """
    if len(points_m) == 0:
        raise DataError("evidence: expected returns to build voxels from, found none; are all scans invalid?")
    lowest, highest = points_m.min(axis=0).astype(np.float64), points_m.max(axis=0).astype(np.float64)
    if not (np.isfinite(lowest).all() and np.isfinite(highest).all()):
        wrong = int((~np.isfinite(points_m).all(axis=1)).sum())
        raise DataError(f"evidence: expected finite returns, found {wrong} of {len(points_m)} that are not")
    # Counted as floats: whole numbers of 32 bits end at 2e9 voxels.
    if np.prod((highest - lowest) / (voxel_m * BRICK) + 2.0) > 250_000_000:
        raise DataError(f"evidence: the returns span {highest - lowest} m, too much for {voxel_m} m voxels")
    low = np.floor(lowest / voxel_m) * voxel_m - voxel_m
    place = points_m - low
    place /= voxel_m
    return index_cells(np.floor(place, out=place).astype(np.int32), low, voxel_m)


def index_cells(place: np.ndarray, origin_m: np.ndarray, voxel_m: float) -> tuple[VoxelIndex, np.ndarray]:
    """Build the index over cells, each a voxel of its own.

    Args:
        place: (n, 3) int, not negative: grid coordinates of points; several may lie in one cell.
        origin_m: (3,) metres: lower corner of the grid.
        voxel_m: Edge of a cell, metres.

    Returns:
        The index, and (n,) int32 voxel numbers.
    """
    shape = place.max(axis=0) // BRICK + 1
    # Shifts and masks of whole numbers are several times as fast as their division.
    brick = np.ravel_multi_index((place >> 3).T, shape)
    bricks = np.full(shape, -1, np.int32)
    bricks_found, brick = _number(bricks.reshape(-1), brick)
    _mark_empty_cubes(bricks)
    within = place & (BRICK - 1)
    cell = brick.astype(np.int64) * BRICK**3 + (within[:, 0] * 64 + within[:, 1] * 8 + within[:, 2])
    cells = np.full((bricks_found, BRICK**3), -1, np.int32)
    _, voxel = _number(cells.reshape(-1), cell)
    edges = np.ones(bricks_found, np.int64)
    return VoxelIndex(origin_m, voxel_m, bricks, cells, occupied_bits(cells), edges), voxel


def _number(table: np.ndarray, place: np.ndarray) -> tuple[int, np.ndarray]:
    """Number the entries `place` (n,) of a flat table of -1 in ascending order, without sorting.

    Returns:
        How many there are, and (n,) int32 the number at each place.
    """
    table[place] = 0
    named = np.flatnonzero(table == 0)
    table[named] = np.arange(len(named), dtype=np.int32)
    return len(named), table[place]


def _mark_empty_cubes(bricks: np.ndarray) -> None:
    """Write into each empty brick in how large an empty cube it lies, see `VoxelIndex.bricks`.

    A ray crosses such a cube in one step. Cubes that reach over the grid's border are not counted.
    """
    for level in range(1, _EMPTY_LEVELS + 1):
        edge = 1 << level
        x, y, z = (length // edge for length in bricks.shape)
        # A view: what is written to it is written to the bricks.
        cubes = bricks[: x * edge, : y * edge, : z * edge].reshape(x, edge, y, edge, z, edge)
        cubes.transpose(0, 2, 4, 1, 3, 5)[(cubes < 0).all(axis=(1, 3, 5))] = -1 - level


PLANE_POINTS = 8
"""Neighbours, itself included, from which a point's plane is fitted."""


def planes_around(point_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Principal axes of each point (n, 3), n >= 8, with its 8 nearest points.

    Returns:
        Sums of squares (n, 3) along the principal axes, ascending; the first axis (n, 3), the unit normal.
    """
    _, near = cKDTree(point_m).query(point_m, PLANE_POINTS)
    apart = point_m[near] - point_m[near].mean(axis=1, keepdims=True)
    values, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", apart, apart))
    return values, axes[:, :, 0]
