import numpy as np
import pytest

from nvsf_core.errors import DataError, ShapeError
from nvsf_core.geometry.se3 import exp_se3, invert_pose, pose_of_angles, transform_points
from nvsf_core.sensors.beam_table import corrected_rays, sensor_rays
from nvsf_core.sensors.sweep import Trajectory, compensate, sweep_fraction
from nvsf_core.sensors.tables import HDL_64E

ORIGIN_M = np.array([1000.0, 3700.0, 115.0])
SCENE = pose_of_angles((1000.0, 3700.0, 115.0), 30.0, 0.0, 0.0)
PERIOD_S = 0.1


def _turning_drive(count=6):
    """A drive along a circle at a constant twist, at KITTI-360's coordinates."""
    start = np.eye(4)
    start[:3, 3] = ORIGIN_M + np.array([3.0, 4.0, 5.0])
    steps = np.arange(count)[:, None] * np.array([1.0, 0.02, 0.0, 0.0, 0.01, 0.05])
    return np.arange(count) * PERIOD_S, start @ exp_se3(steps)


def test_the_sweep_runs_clockwise_from_half_a_turn_before_to_half_a_turn_after():
    azimuth = np.array([np.pi, np.pi / 2, 0.0, -np.pi / 2, -np.pi + 1e-9])
    np.testing.assert_allclose(sweep_fraction(azimuth), [-0.5, -0.25, 0.0, 0.25, 0.5], atol=1e-9)
    assert sweep_fraction(np.array([-np.pi])) == -0.5


def test_at_a_pose_s_instant_the_trajectory_is_that_pose():
    times_s, poses = _turning_drive()
    rotation, position_m = Trajectory(times_s, poses, SCENE).at(times_s)
    local = invert_pose(SCENE) @ poses
    np.testing.assert_allclose(rotation, local[:, :3, :3], atol=1e-12)
    np.testing.assert_allclose(position_m, local[:, :3, 3], atol=1e-9)


def test_a_constant_twist_is_met_between_in_a_gap_and_beyond_both_ends():
    times_s, poses = _turning_drive(8)
    kept = [1, 2, 5, 6]  # frames 3 and 4 are missing, 0 and 7 lie beyond
    trajectory = Trajectory(times_s[kept], poses[kept], SCENE)
    rotation, position_m = trajectory.at(times_s)
    local = invert_pose(SCENE) @ poses
    np.testing.assert_allclose(rotation, local[:, :3, :3], atol=1e-9)
    np.testing.assert_allclose(position_m, local[:, :3, 3], atol=1e-9)


def test_times_far_outside_are_refused():
    trajectory = Trajectory(*_turning_drive(), SCENE)
    with pytest.raises(DataError, match=r"0\.7"):
        trajectory.at(np.array([0.7]))
    with pytest.raises(DataError):
        trajectory.at(np.array([np.nan]))


def test_frames_may_be_nearer_to_each_other_than_half_a_sweep_is_long():
    times_s, poses = _turning_drive()
    often = Trajectory(0.4 * times_s, poses, SCENE)
    # Half a sweep before the first pose is 1.25 steps before it: the motion goes on.
    _, position_m = often.at(np.array([-0.5 * PERIOD_S]))
    back = exp_se3(-1.25 * np.array([[1.0, 0.02, 0.0, 0.0, 0.01, 0.05]]))
    expected_m = transform_points(invert_pose(SCENE), (poses[0] @ back[0])[:3, 3][None])
    np.testing.assert_allclose(position_m, expected_m, atol=1e-9)
    with pytest.raises(DataError, match=r"within -0\.1000 \.\. 0\.3000 s"):
        often.at(np.array([0.31]))


def test_a_single_pose_stands_still():
    times_s, poses = _turning_drive(1)
    rotation, position_m = Trajectory(times_s, poses, SCENE).at(np.array([-5.0, 0.0, 9.0]))
    assert rotation.shape == (3, 3, 3)
    np.testing.assert_allclose(
        position_m, np.repeat(transform_points(invert_pose(SCENE), poses[:, :3, 3]), 3, axis=0)
    )


def test_bad_poses_are_refused():
    times_s, poses = _turning_drive()
    with pytest.raises(DataError, match="ascending"):
        Trajectory(times_s[::-1], poses, SCENE)
    with pytest.raises(DataError, match="finite"):
        Trajectory(times_s, np.full_like(poses, np.nan), SCENE)
    with pytest.raises(ShapeError):
        Trajectory(times_s[:3], poses, SCENE)


def test_compensated_returns_lie_where_the_moving_sensor_saw_them():
    trajectory = Trajectory(*_turning_drive(), SCENE)
    rng = np.random.default_rng(0)
    laser, azimuth = rng.integers(0, 64, 5000), rng.uniform(-np.pi, np.pi, 5000)
    range_m, fraction = rng.uniform(3.0, 70.0, 5000), sweep_fraction(azimuth)
    origin_s, direction_s = sensor_rays(HDL_64E, azimuth, laser)
    recorded_m = origin_s + range_m[:, None] * direction_s
    time_s = 0.2 + fraction * PERIOD_S
    origin_m, direction, found_m = compensate(HDL_64E, recorded_m, laser, time_s, trajectory)
    # The same rays fired from the pose of each one's own time.
    true_origin_m, true_direction = trajectory.move_rays(*corrected_rays(HDL_64E, azimuth, laser), time_s)
    np.testing.assert_allclose(found_m, range_m, atol=1e-10)
    np.testing.assert_allclose(origin_m, true_origin_m, atol=1e-9)
    np.testing.assert_allclose(direction, true_direction, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1.0)


def test_at_one_instant_the_whole_scan_is_at_its_pose():
    times_s, poses = _turning_drive()
    trajectory = Trajectory(times_s, poses, SCENE)
    rng = np.random.default_rng(1)
    points_m = rng.normal(size=(500, 3)) * 20
    origin_m, direction, range_m = compensate(
        HDL_64E, points_m, np.full(500, -1), np.full(500, times_s[2]), trajectory,
        elevation_correction_rad=0.0,
    )  # fmt: skip
    expected_m = transform_points(invert_pose(SCENE) @ poses[2], points_m)
    np.testing.assert_allclose(origin_m + range_m[:, None] * direction, expected_m, atol=1e-9)


def test_rays_of_several_frames_move_at_once():
    times_s, poses = _turning_drive()
    origin_s, direction_s = sensor_rays(HDL_64E, np.zeros(6), np.zeros(6, np.int64))
    frames = np.arange(6)
    origin_m, direction = Trajectory(times_s, poses, SCENE).move_rays(origin_s, direction_s, times_s)
    local = invert_pose(SCENE) @ poses
    for k in frames:
        np.testing.assert_allclose(origin_m[k], transform_points(local[k], origin_s)[0], atol=1e-9)
        np.testing.assert_allclose(direction[k], local[k, :3, :3] @ direction_s[0], atol=1e-12)
