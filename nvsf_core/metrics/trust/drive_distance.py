"""How far returns lie from all that a drive recorded.

One direction only: a drive holds far more than one scan sees. `away` is the share of the returns farther from
every recorded one than the F-score allows. The density-aware Chamfer distance (Wu et al., NeurIPS 2021,
equation 5, its half from the scan to the drive) also notices returns that crowd around a few recorded ones:
mean over the scan of 1 - exp(-d / a) / n, with d the distance to the nearest recorded point and n the number
of the scan's points that have the same nearest one. A scan without returns shows nothing of the drive: it is
as far from it as a scan can be, by both.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from nvsf_core.errors import DataError
from nvsf_core.metrics.point_cloud import F_THRESHOLD_M2

_CELL_M = 0.1
"""Clouds are thinned to a point a cell, so that densities compare."""
_SCALE_M = 0.22
"""`a`: at this distance, the F-score's, a point counts as 63 % wrong."""
_EVERY = 5
"""Of the returns, so many are one that is asked for `away`."""
_FARTHEST = 1.0
"""Of a scan without returns: the largest value that both can have."""


class DriveCloud:
    """All recorded returns of a drive, thinned."""

    def __init__(self, scans_m: Sequence[np.ndarray]) -> None:
        """Take the returns (n, 3) of each scan, metres, all in one frame.

        Raises:
            DataError: There is no return.
        """
        if sum(map(len, scans_m)) == 0:
            raise DataError("the drive's cloud: expected recorded returns, found none; leave it out")
        self._tree = cKDTree(thinned(np.concatenate(scans_m)))

    def away(self, points_m: np.ndarray) -> float:
        """Share of the points (n, 3) that are farther than 22 cm from every recorded one; 1 for none."""
        if len(points_m) == 0:
            return _FARTHEST
        distance_m, _ = self._tree.query(points_m[::_EVERY])
        return float(np.mean(np.square(distance_m) >= F_THRESHOLD_M2))

    def density_aware(self, points_m: np.ndarray) -> float:
        """Density-aware Chamfer distance, 0..1, from points (n, 3) to the drive; 1 for none."""
        if len(points_m) == 0:
            return _FARTHEST
        distance_m, nearest = self._tree.query(thinned(points_m))
        _, place, count = np.unique(nearest, return_inverse=True, return_counts=True)
        return float(np.mean(1.0 - np.exp(-distance_m / _SCALE_M) / count[place]))


def thinned(points_m: np.ndarray) -> np.ndarray:
    """The first point of each cell of 10 cm of points (n, 3), float64."""
    cell = np.floor(points_m.astype(np.float64) / _CELL_M).astype(np.int64)
    cell -= cell.min(axis=0)
    sides = cell.max(axis=0) + 1
    _, first = np.unique((cell[:, 0] * sides[1] + cell[:, 1]) * sides[2] + cell[:, 2], return_index=True)
    return points_m[first].astype(np.float64)
