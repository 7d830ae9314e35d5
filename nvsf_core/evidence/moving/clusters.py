"""Clusters of one scan: groups of connected returns, enough of which were labelled as moved."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from nvsf_core.evidence.moving.timed_returns import TimedReturns
from nvsf_core.evidence.moving.visibility import SEED, STATIC, AboveGround

_VOXEL_M = 0.25
_LINK_M = 0.5
_LEAST_SEEDS = 8
_FEWEST_SEEDS = 3
_USUAL_SPACING_RAD = 0.007
"""Angle between neighbouring lasers of the 64-laser sensor for which all numbers of returns are given."""
_SEED_SHARE = 0.4
_SEEDS_PER_STATIC = 2.0
_LONGEST_M = 12.0


@dataclass(frozen=True, slots=True, eq=False)
class Cluster:
    """One probably moving object in one scan."""

    scan: int
    """Number of the scan."""
    members: np.ndarray
    """(k,) int64 indices of its returns among all returns."""
    time_s: float
    """Mean time of its returns."""
    centre_m: np.ndarray
    """(3,) float64 mean of its returns, scene-local metres."""
    size_m: float
    """Diagonal of its axis-aligned box."""
    nearest_m: float
    """Range of its nearest return."""


def laser_density(spacing_rad: float) -> float:
    """Returns that a sensor gets from an object, relative to a 64-laser sensor; at most 1."""
    return min(1.0, _USUAL_SPACING_RAD / spacing_rad)


def pull_together(
    point_m: np.ndarray, above_sensor_m: np.ndarray, range_m: np.ndarray, spacing_rad: float
) -> np.ndarray:
    """Points (m, 3) moved towards the sensor's height until rows of neighbouring lasers can be linked.

    Args:
        point_m: (m, 3) scene-local, metres.
        above_sensor_m: (m,) heights above the sensor.
        range_m: (m,) ranges from the sensor.
        spacing_rad: Angle between neighbouring lasers.
    """
    pulled = point_m.copy()
    pulled[:, 2] -= above_sensor_m * (1.0 - np.minimum(1.0, _LINK_M / (spacing_rad * range_m)))
    return pulled


def cluster_scan(
    scan: int, returns: TimedReturns, above_ground: AboveGround, range_m: np.ndarray, spacing_rad: float
) -> list[Cluster]:
    """Clusters of a scan's returns above the ground that probably move.

    Voxels are linked to others within half a metre, but not those that are mostly static.

    Args:
        scan: Number of the scan.
        returns: All training returns.
        above_ground: Those that may move, with their labels.
        range_m: (N,) ranges of all returns.
        spacing_rad: Angle between neighbouring lasers.
    """
    index, label = above_ground.of_scan(scan)
    least_seeds = max(_FEWEST_SEEDS, _LEAST_SEEDS * laser_density(spacing_rad))
    if (label == SEED).sum() < least_seeds:
        return []
    point_m, range_m = returns.point_m[index], range_m[index]
    group = _groups(pull_together(point_m, returns.recorded_m[index, 2], range_m, spacing_rad), label)
    count = int(group.max(initial=-1)) + 1
    seeds = np.bincount(group[(label == SEED) & (group >= 0)], minlength=count)
    static = np.bincount(group[(label == STATIC) & (group >= 0)], minlength=count)
    size = np.bincount(group[group >= 0], minlength=count)
    moving = (seeds >= least_seeds) & (seeds >= _SEED_SHARE * size) & (seeds >= _SEEDS_PER_STATIC * static)
    clusters = []
    for chosen in np.flatnonzero(moving):
        rows = np.flatnonzero(group == chosen)
        points = point_m[rows].astype(np.float64)
        extent = np.ptp(points, axis=0)
        if np.hypot(extent[0], extent[1]) > _LONGEST_M:
            continue
        clusters.append(
            Cluster(
                scan=scan,
                members=index[rows],
                time_s=float(returns.time_s[index[rows]].mean()),
                centre_m=points.mean(axis=0),
                size_m=float(np.linalg.norm(extent)),
                nearest_m=float(range_m[rows].min()),
            )
        )
    return clusters


def _groups(point_m: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Number (m,) of the linked group of each point (m, 3); -1 in mostly static voxels."""
    cell = np.floor(point_m / _VOXEL_M).astype(np.int64)
    cell -= cell.min(axis=0)
    extent = cell.max(axis=0) + 1
    key = (cell[:, 0] * extent[1] + cell[:, 1]) * extent[2] + cell[:, 2]
    keys, voxel = np.unique(key, return_inverse=True)
    static_share = np.bincount(voxel, weights=label == STATIC) / np.bincount(voxel)
    kept = np.flatnonzero(static_share <= 0.5)
    group = np.full(len(keys), -1)
    if len(kept):
        rest, z = np.divmod(keys[kept], extent[2])
        x, y = np.divmod(rest, extent[1])
        centre = np.stack([x, y, z], axis=1) * _VOXEL_M
        pairs = cKDTree(centre).query_pairs(_LINK_M + 1e-6, output_type="ndarray")
        links = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(len(kept),) * 2)
        group[kept] = connected_components(links, directed=False)[1]
    return group[voxel]
