"""The path of a view's sensors if it is not the recorded one: a smooth curve through poses, or a file's."""

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from nvsf_core.drives.view_entry import ViewEntry
from nvsf_core.geometry.angles import pose_of_angles
from nvsf_core.geometry.se3 import exp_se3, invert_pose, log_se3, pose_from_parts
from nvsf_core.sensors.sweep import Trajectory

_STEP_S = 0.02
"""Time between the poses that a smooth curve is cut into; between them the motion is constant."""
_MOST_KNOTS = 100_000
_SPARE_S = 1.0
"""Both ends go on unchanged for so long: a sweep begins before its pose's instant."""


def view_path(view: ViewEntry, start_to_world: np.ndarray, scene_origin_m: np.ndarray) -> Trajectory | None:
    """The path that a view's entry gives; None if it follows the recorded one.

    Args:
        view: The entry.
        start_to_world: (4, 4) first recorded pose of the LiDAR: the frame `start`.
        scene_origin_m: (3,) the scene's origin in the world.
    """
    if view.is_on_recorded_path:
        return None
    if view.pose_file is not None:
        times_s = np.array(view.pose_file.time_s)
        poses = np.tile(np.eye(4), (len(times_s), 1, 1))
        poses[:, :3] = np.array(view.pose_file.poses).reshape(-1, 3, 4)
    else:
        times_s, poses = _smooth(view)
    if view.path_in == "start":
        poses = start_to_world @ poses
    return Trajectory(*_prolonged(times_s, poses), scene_origin_m)


def _smooth(view: ViewEntry) -> tuple[np.ndarray, np.ndarray]:
    """Times (k,) and poses (k, 4, 4) of a curve through the waypoints, without kinks in place or rotation."""
    given_s = np.array([point.time_s for point in view.waypoints], np.float64)
    poses = np.stack([
        pose_of_angles(point.position_m, point.yaw_deg, point.pitch_deg, point.roll_deg)
        for point in view.waypoints
    ])  # fmt: skip
    if len(given_s) == 1:
        return given_s, poses
    count = min(_MOST_KNOTS, max(2, int(np.ceil((given_s[-1] - given_s[0]) / _STEP_S)) + 1))
    times_s = np.linspace(given_s[0], given_s[-1], count)
    place_m = CubicSpline(given_s, poses[:, :3, 3], bc_type="natural")(times_s)
    turned = RotationSpline(given_s, Rotation.from_matrix(poses[:, :3, :3]))(times_s).as_matrix()
    return times_s, pose_from_parts(turned, place_m)


def _prolonged(times_s: np.ndarray, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The path with both ends moved on by their own motion for `_SPARE_S`; a single pose holds for ever."""
    if len(times_s) == 1:
        return times_s, poses
    ends = []
    for first, second in ((0, 1), (-1, -2)):
        twist = log_se3(
            invert_pose(poses[first : first + 1 or None][:1]) @ poses[second : second + 1 or None][:1]
        )
        share = -_SPARE_S / abs(times_s[second] - times_s[first])
        ends.append(poses[first] @ exp_se3(share * twist)[0])
    known_s = np.concatenate([[times_s[0] - _SPARE_S], times_s, [times_s[-1] + _SPARE_S]])
    return known_s, np.concatenate([ends[0][None], poses, ends[1][None]])
