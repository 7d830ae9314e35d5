"""Finds scans with a wrong pose: they fit their neighbours better at another frame's pose."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

_NEIGHBOURS = 2
"""Number of scans before and after that a scan is compared with, and whose poses are tried."""
_FARTHEST_M = 1.0
"""Largest distance that counts: a surface that only one scan saw must not decide."""


def scan_misfits(points_m: Sequence[np.ndarray], lidar_to_scene: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean distance of each scan's points from its neighbours', at its own pose and at the best of theirs.

    The second is the smaller one for a scan that belongs to another frame. Both are equal where the sensor
    does not move.

    Args:
        points_m: For each of n scans (N, 3) scene-local metres, placed by its own pose; few, evenly spread.
        lidar_to_scene: (n, 4, 4) poses of the scans.

    Returns:
        Two (n,) float64 in metres, at most 1; NaN where the scan or all its neighbours have no points.
    """
    n = len(points_m)
    own_m, best_other_m = np.full(n, np.nan), np.full(n, np.nan)
    for k, points in enumerate(points_m):
        near = [j for j in range(max(0, k - _NEIGHBOURS), min(n, k + _NEIGHBOURS + 1)) if j != k]
        around = np.concatenate([np.zeros((0, 3)), *(points_m[j] for j in near)])
        if len(points) == 0 or len(around) == 0:
            continue
        tree = cKDTree(around)
        from_pose = np.linalg.inv(lidar_to_scene[k])
        own_m[k] = _distance_m(tree, points, np.eye(4))
        best_other_m[k] = min(_distance_m(tree, points, lidar_to_scene[j] @ from_pose) for j in near)
    return own_m, best_other_m


def _distance_m(tree: cKDTree, points_m: np.ndarray, motion: np.ndarray) -> float:
    """Mean distance of points (N, 3), moved by (4, 4), from the nearest in the tree."""
    moved_m = points_m @ motion[:3, :3].T + motion[:3, 3]
    distance_m, _ = tree.query(moved_m, distance_upper_bound=_FARTHEST_M)
    return float(np.minimum(distance_m, _FARTHEST_M).mean())
