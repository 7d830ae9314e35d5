"""Scans between those of a path in which its object was seen, but not linked to the others.

A car that passes shows its front, its side and its rear within a few scans: the mean of its returns jumps
along it, and its track goes on only behind the jump.
"""

import numpy as np
from scipy.spatial import cKDTree

from nvsf_core.evidence.moving.path_fitting import LEAST_RETURNS, Path
from nvsf_core.evidence.moving.visibility import AboveGround, TimedReturns

_NEAR_SHAPE_M = 0.3
"""A box instead, of what stands at an angle to its axes, would hold much that is beside it."""


def fill_gaps(path: Path, returns: TimedReturns, above_ground: AboveGround) -> bool:
    """Add the scans between a path's own that have returns where the object was; True if one was added.

    Nothing else can have been there: of all returns near its shape, at the pose between those of the scans
    around, only those that are labelled static are left out.
    """
    missing = np.setdiff1d(np.arange(path.scan[0], path.scan[-1]), path.scan)
    if len(missing) == 0:
        return False
    moving, shape_o = path.as_object(returns.frame_s), path.shape(returns)
    tree = cKDTree(shape_o)
    # The object is met up to half a sweep before or after the scan's instant.
    reach_m = np.abs(shape_o).max() + _NEAR_SHAPE_M + path.fastest_m_s * 0.5 * returns.period_s
    found = []
    for scan in missing.tolist():
        pose = moving.pose_at(returns.scan_time_s[scan : scan + 1])[0]
        near = above_ground.loose_near(returns, scan, pose[:3] - reach_m, pose[:3] + reach_m)
        local = moving.to_object(returns.point_m[near].astype(np.float64), returns.time_s[near])
        distance_m, _ = tree.query(local, distance_upper_bound=_NEAR_SHAPE_M)
        members = near[np.isfinite(distance_m)]
        if len(members) >= LEAST_RETURNS:
            time_s = float(returns.time_s[members].mean())
            found.append((scan, members, time_s, moving.pose_at(np.array([time_s]))[0]))
    for scan, members, time_s, pose in found:
        path.insert(int(np.searchsorted(path.scan, scan)), scan, members, time_s, pose)
    return len(found) > 0
