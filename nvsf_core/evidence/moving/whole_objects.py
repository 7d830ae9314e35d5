"""The whole objects of solved paths: all loose returns near the shape that a path has gathered."""

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from nvsf_core.evidence.moving.object_evidence import MovingObject, MovingObjects
from nvsf_core.evidence.moving.path_fitting import Path
from nvsf_core.evidence.moving.visibility import AboveGround, TimedReturns

LEAST_SCANS = 3
"""Fewer scans show no motion."""
_MODEL_VOXEL_M = 0.15
_GROW_M = 0.3
_LEAST_RETURNS = 30
_MOST_OF_WORLD_SHAPE = 0.8
"""Most voxels that an object's returns may fill in its own frame, as a share of those they fill in the world.
What does not move, such as a hedge whose visible side changes, fills as many or more."""
_OWN_VEHICLE_M = 2.5
"""What is never farther from the sensor than this is part of the own vehicle, such as an antenna."""


def whole_objects(
    paths: list[Path], returns: TimedReturns, above_ground: AboveGround, density: float
) -> MovingObjects:
    """Give each object, largest first, its extent and all loose returns near its accumulated shape."""
    object_id = np.full(len(returns.point_m), -1, np.int32)
    objects: list[MovingObject] = []
    for path in sorted(paths, key=lambda p: (-sum(map(len, p.members)), p.scan[0])):
        moving = path.as_object(returns.frame_s)
        shape_o = _thinned(path.shape(returns))
        taken = _take(moving, shape_o, returns, above_ground, object_id)
        local = moving.to_object(returns.point_m[taken].astype(np.float64), returns.time_s[taken])
        if not _is_object(taken, local, returns, _LEAST_RETURNS * density):
            continue
        object_id[taken] = len(objects)
        objects.append(replace(moving, low_m=local.min(axis=0), high_m=local.max(axis=0)))
    return MovingObjects(tuple(objects), object_id, density)


def _is_object(taken: np.ndarray, local_m: np.ndarray, returns: TimedReturns, fewest: float) -> bool:
    """Whether returns (k,), at (k, 3) in the object's frame, form one object that its path explains."""
    if len(taken) < fewest or len(np.unique(returns.scan_of(taken))) < LEAST_SCANS:
        return False
    if np.linalg.norm(returns.recorded_m[taken], axis=1).max() < _OWN_VEHICLE_M:
        return False
    return len(_thinned(local_m)) < _MOST_OF_WORLD_SHAPE * len(_thinned(returns.point_m[taken]))


def _take(
    moving: MovingObject,
    shape_o: np.ndarray,
    returns: TimedReturns,
    above_ground: AboveGround,
    object_id: np.ndarray,
) -> np.ndarray:
    """Indices of all free loose returns within 0.3 m of the shape (k, 3), compared in the object's frame."""
    tree = cKDTree(shape_o)
    reach = np.abs(shape_o).max() + _GROW_M + 1.0
    taken = []
    for scan, pose in zip(moving.scan, moving.pose, strict=True):
        near = above_ground.loose_near(returns, int(scan), pose[:3] - reach, pose[:3] + reach)
        near = near[object_id[near] < 0]
        local = moving.to_object(returns.point_m[near].astype(np.float64), returns.time_s[near])
        distance, _ = tree.query(local, distance_upper_bound=_GROW_M)
        taken.append(near[np.isfinite(distance)])
    return np.concatenate(taken)


def _thinned(point_o: np.ndarray) -> np.ndarray:
    """Means of the points (k, 3) in each voxel of 0.15 m."""
    _, voxel = np.unique(np.floor(point_o / _MODEL_VOXEL_M).astype(np.int64), axis=0, return_inverse=True)
    voxel = voxel.ravel()
    count = np.bincount(voxel)
    return np.stack([np.bincount(voxel, weights=point_o[:, a]) / count for a in range(3)], axis=1)
