"""Whether scans would agree if their poses were read by another convention: what to correct, in words."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

Misfit = Callable[[Sequence[np.ndarray], np.ndarray], float]
"""Mean distance of scans' points, (N, 3) each, placed by poses (n, 4, 4), from their neighbours'."""

_MUCH_BETTER = 0.75
"""Measured on streets of all headings: 0.47 to 0.61 for the right reading of quaternions in another order;
the best wrong reading of right poses 1.3 or more."""


def other_reading(points_m: Sequence[np.ndarray], lidar_to_world: np.ndarray, misfit: Misfit) -> str:
    """How poses would have to be read for scans to agree; empty where no other reading is much better.

    Poses of another frame than the LiDAR's, composed with its mounting, are not tried.

    Args:
        points_m: For each of n scans (N, 3), LiDAR frame, metres.
        lidar_to_world: (n, 4, 4) float64 poses as they were read.
        misfit: How far scans lie apart.
    """

    def apart_m(poses: np.ndarray) -> float:
        poses = poses.copy()
        poses[:, :3, 3] -= poses[0, :3, 3].copy()  # beside millions of metres, centimetres would be lost
        placed = zip(points_m, poses, strict=True)
        return misfit([one @ pose[:3, :3].T + pose[:3, 3] for one, pose in placed], poses)

    found_m = {words: apart_m(read(lidar_to_world)) for words, read in _READINGS.items()}
    best = min(found_m, key=lambda words: found_m[words])
    return best if found_m[best] < _MUCH_BETTER * apart_m(lidar_to_world) else ""


def _of_order(order: Sequence[int]) -> Callable[[np.ndarray], np.ndarray]:
    """Read the numbers of each quaternion in another order than x, y, z, w."""

    def read(poses: np.ndarray) -> np.ndarray:
        found = poses.copy()
        numbers = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
        found[:, :3, :3] = Rotation.from_quat(numbers[:, order]).as_matrix()
        return found

    return read


_READINGS: Mapping[str, Callable[[np.ndarray], np.ndarray]] = {
    "if their quaternions are taken as w, x, y, z: write x, y, z, w": _of_order((1, 2, 3, 0)),
    "if their quaternions are taken as y, z, w, x: write x, y, z, w": _of_order((3, 0, 1, 2)),
    "if they are inverted: write poses of the LiDAR in the world": np.linalg.inv,
}
