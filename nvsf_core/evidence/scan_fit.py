"""Whether a scan lies best over its neighbours at its own pose, or at another frame's."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

_NEIGHBOURS = 2
"""Scans before and after that one is held against, and whose poses it is tried at."""
_FARTHEST_M = 1.0
"""A point farther from all others counts as this far: what only one scan saw must not decide."""


def scan_misfits(points_m: Sequence[np.ndarray], lidar_to_scene: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean distance of each scan's points to its neighbours', at its own pose and at the best of theirs.

    Of a scan that belongs to another frame the second is the smaller. Where the sensor stands all poses,
    and so both distances, are the same.

    Args:
        points_m: Of each scan (N, 3), laid by its own pose, in the scene's axes, few and evenly spread.
        lidar_to_scene: (n, 4, 4) the scans' poses in the same axes.

    Returns:
        Two (n,) float64 in metres, at most 1; NaN for a scan without points or neighbours with any.
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
    """Mean distance of moved points to the nearest in the tree."""
    moved_m = points_m @ motion[:3, :3].T + motion[:3, 3]
    distance_m, _ = tree.query(moved_m, distance_upper_bound=_FARTHEST_M)
    return float(np.minimum(distance_m, _FARTHEST_M).mean())
