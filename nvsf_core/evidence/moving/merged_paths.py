"""Paths of parts of one object, joined: where lasers are few, a car's rows are clusters of their own."""

import numpy as np

from nvsf_core.evidence.moving.object_evidence import MovingObject
from nvsf_core.evidence.moving.path_fitting import Path, solve_path
from nvsf_core.evidence.moving.visibility import TimedReturns

_LEAST_SHARED = 4
"""Scans in which both must be seen for their motions to be compared."""
_APART_M = 0.3
"""Parts of one object stay where they are in its frame up to this: paths with few returns are so exact."""
_AGREE_SHARE = 0.7
"""In so many of the scans that both share; at a path's ends some are mistakes."""
_BESIDE_M = 0.5
"""A part may lie so far beside the rest, seen from above: of a car ahead one sees tail and rear window."""
_OVERLAP = 0.5
"""Least share of the part's returns there."""
_WITHIN_PERCENT = (2.0, 98.0)


def merge_paths(paths: list[Path], returns: TimedReturns) -> list[Path]:
    """The paths, largest first; parts that lie above one another and move alike are one path, solved anew."""
    merged: list[Path] = []
    for path in sorted(paths, key=lambda p: (-sum(map(len, p.members)), p.scan[0])):
        whole = next((one for one in merged if _is_part(path, one, returns)), None)
        if whole is None:
            merged.append(path)
        else:
            _join(whole, path, returns)
            solve_path(whole, returns)
    return merged


def _is_part(part: Path, whole: Path, returns: TimedReturns) -> bool:
    """Whether a path is that of a part of an object: above or below the rest of it, moving with it."""
    shared, _, rows = np.intersect1d(whole.scan, part.scan, return_indices=True)
    if len(shared) < _LEAST_SHARED:
        return False
    offset_m = _offset(part, whole.as_object(returns.frame_s), rows)[:, :2]
    apart_m = np.linalg.norm(offset_m - np.median(offset_m, axis=0), axis=1)
    if (apart_m <= _APART_M).mean() < _AGREE_SHARE:
        return False
    low_m, high_m = np.percentile(_plan(whole, whole, shared, returns), _WITHIN_PERCENT, axis=0)
    plan_m = _plan(part, whole, shared, returns)
    overlaps = np.all((plan_m > low_m - _BESIDE_M) & (plan_m < high_m + _BESIDE_M), axis=1)
    return bool(overlaps.mean() >= _OVERLAP)


def _offset(part: Path, whole: MovingObject, rows: np.ndarray) -> np.ndarray:
    """Places (k, 4) of a part's frame in the object's, metres and a yaw in radians, in its scans `rows`."""
    pose, time_s = part.pose[rows], part.time_s[rows]
    return np.column_stack([whole.to_object(pose[:, :3], time_s), pose[:, 3] - whole.pose_at(time_s)[:, 3]])


def _plan(path: Path, whole: Path, scans: np.ndarray, returns: TimedReturns) -> np.ndarray:
    """Places (k, 2), in the object's frame and seen from above, of a path's returns in some scans."""
    members = np.concatenate([path.members[row] for row in np.flatnonzero(np.isin(path.scan, scans))])
    moving = whole.as_object(returns.frame_s)
    return moving.to_object(returns.point_m[members].astype(np.float64), returns.time_s[members])[:, :2]


def _join(whole: Path, part: Path, returns: TimedReturns) -> None:
    """Add a part's scans and returns to a path, in place."""
    _, _, rows = np.intersect1d(whole.scan, part.scan, return_indices=True)
    moving = whole.as_object(returns.frame_s)
    offset_o = np.median(_offset(part, moving, rows), axis=0)
    for scan, members, pose in zip(part.scan, part.members, part.pose, strict=True):
        at = int(np.searchsorted(whole.scan, scan))
        if at < len(whole.scan) and whole.scan[at] == scan:
            whole.members[at] = np.union1d(whole.members[at], members)
            whole.time_s[at] = returns.time_s[whole.members[at]].mean()
            whole.pose[at] = moving.pose_at(whole.time_s[at : at + 1])[0]
        else:
            yaw_rad = pose[3] - offset_o[3]
            ahead = MovingObject.turn_to_object(offset_o[None, :3], np.array([-yaw_rad]))[0]
            own = np.array([*(pose[:3] - ahead), yaw_rad])
            whole.insert(at, scan, members, float(returns.time_s[members].mean()), own)
