"""Which way the ground below a LiDAR faces, from the scans around it."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

_NEIGHBOURS = 10
_FARTHEST_M = 2.0
"""Points whose ten nearest reach farther have no normal."""
_FLAT = 0.1
"""Most spread across a surface, of that along its narrower side, both squared."""
_NEAR_M = 10.0
_STEEPEST_COS = float(np.cos(np.deg2rad(50.0)))
"""Surfaces that face farther from z are walls."""
_ALIKE_COS = float(np.cos(np.deg2rad(5.0)))
_LEAST_SHARE = 0.5
"""Share of the surfaces that must face as the ground does: from 0.69 on streets, 0.08 where none is seen."""
_FEWEST_NORMALS, _MOST_NORMALS = 50, 800
_MOST_SCANS = 8
_SCANS_AROUND = 2


def surface_normals(points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (n, 3) of (N, 3) that have neighbours enough, their unit normals (n, 3), and is it flat (n,)."""
    count = min(_NEIGHBOURS, len(points_m))
    if count < 3:
        return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, np.bool_)
    distance_m, index = cKDTree(points_m).query(points_m, k=count)
    has_enough = distance_m[:, -1] < _FARTHEST_M
    around_m = points_m[index[has_enough]]
    arms_m = around_m - around_m.mean(axis=1, keepdims=True)
    spread_m2, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", arms_m, arms_m))
    return points_m[has_enough], axes[:, :, 0], spread_m2[:, 0] < _FLAT * spread_m2[:, 1]


def ground_normals(
    clouds_m: Sequence[np.ndarray], lidar_to_scene: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The ground's normal around some scans, evenly chosen: what most surfaces near the LiDAR face.

    Args:
        clouds_m: For each of n scans (N, 3) scene-local metres, thinned.
        lidar_to_scene: (n, 4, 4) poses of the scans.

    Returns:
        Unit normals (k, 3) towards the scene's z, scene axes; the scans (k,) they are of, only those where
        ground is seen; and the share (k,) of its surfaces that lie on the LiDAR's lower side by that normal.
    """
    n = len(clouds_m)
    chosen = np.unique(np.linspace(0, n - 1, min(_MOST_SCANS, n)).astype(np.int64))
    found, below = {}, []
    for k in chosen.tolist():
        around_m = np.concatenate(clouds_m[max(0, k - _SCANS_AROUND) : k + _SCANS_AROUND + 1])
        near = np.linalg.norm(around_m - lidar_to_scene[k, :3, 3], axis=1) < _NEAR_M
        placed_m, *facing = surface_normals(around_m[near])
        ground = _most_common(placed_m - lidar_to_scene[k, :3, 3], *facing)
        if ground is not None:
            found[k], share = ground
            below.append(share)
    return np.array(list(found.values())).reshape(-1, 3), np.array(list(found), np.int64), np.array(below)


def _most_common(
    from_lidar_m: np.ndarray, normals: np.ndarray, is_flat: np.ndarray
) -> tuple[np.ndarray, float] | None:
    """What half of the level surfaces face within 5 degrees, (3,) upwards; their share below the LiDAR."""
    upward = normals * np.where(normals[:, 2:] < 0.0, -1.0, 1.0)
    is_level = is_flat & (upward[:, 2] > _STEEPEST_COS)
    if np.count_nonzero(is_level) < _FEWEST_NORMALS:
        return None
    step = -(-np.count_nonzero(is_level) // _MOST_NORMALS)
    upward, from_lidar_m = upward[is_level][::step], from_lidar_m[is_level][::step]
    is_alike = upward @ upward.T > _ALIKE_COS
    best = is_alike[is_alike.sum(axis=1).argmax()]
    if best.mean() < _LEAST_SHARE:
        return None
    mean = upward[best].mean(axis=0)
    normal: np.ndarray = mean / np.linalg.norm(mean)
    return normal, float(np.mean(from_lidar_m[best] @ normal < 0.0))
