"""A path is refined by the surfaces that several scans saw; what none of them fixes stays as it was."""

import numpy as np
import pytest

from nvsf_core.clouds.path_refinement import refine_path
from nvsf_core.geometry.se3 import exp_se3, invert_pose, transform_points

_STEP_M = 0.8
_SENSOR_M = 1.7


def _street(rng: np.random.Generator, x_m: float, house_fronts: bool) -> np.ndarray:
    """A road and two walls, 18 m around a place on the way; houses stand out of the walls."""
    x = x_m + rng.uniform(-18.0, 18.0, 6_000)
    side = rng.integers(0, 4, len(x))
    y, z = rng.uniform(-8.0, 8.0, len(x)), np.full(len(x), -_SENSOR_M)
    walls = side >= 2
    y[walls] = np.sign(y[walls]) * 8.0
    z[walls] = rng.uniform(-_SENSOR_M, 4.0, walls.sum())
    if house_fronts:
        front = side == 3
        x[front] = np.round(x[front] / 7.0) * 7.0
        y[front] = np.sign(y[front]) * rng.uniform(5.0, 8.0, front.sum())
    return np.stack([x, y, z], axis=1) + rng.normal(0.0, 0.01, (len(x), 3))


def _lowered(points_m: np.ndarray, angle_rad: float) -> np.ndarray:
    """Points of rays whose elevations are recorded too low."""
    across_m = np.linalg.norm(points_m[:, :2], axis=1)
    low_rad = np.arctan2(points_m[:, 2], across_m) - angle_rad
    range_m = np.linalg.norm(points_m, axis=1)
    return np.column_stack([
        points_m[:, :2] * (range_m * np.cos(low_rad) / across_m)[:, None], range_m * np.sin(low_rad)
    ])  # fmt: skip


def _drive(
    count: int, house_fronts: bool = True, angle_rad: float = 0.0
) -> tuple[list[tuple[np.ndarray, np.ndarray]], np.ndarray, np.ndarray]:
    """Scans of a curved drive, moving while they are taken, its path, and one with an odometry's errors."""
    rng = np.random.default_rng(0)
    twist = np.array([_STEP_M, 0.0, 0.0, 0.0, 0.0, 0.002])
    true = exp_se3(np.arange(count)[:, None] * twist)
    scans = []
    for pose in true:
        seen_m = transform_points(invert_pose(pose), _street(rng, pose[0, 3], house_fronts))
        fraction = rng.uniform(-0.5, 0.5, len(seen_m))
        moved = invert_pose(exp_se3(fraction[:, None] * twist))
        seen_m = np.einsum("nij,nj->ni", moved[:, :3, :3], seen_m) + moved[:, :3, 3]
        scans.append((_lowered(seen_m, angle_rad).astype(np.float32), fraction))
    off = rng.normal(0.0, [0.02, 0.02, 0.02, 0.002, 0.002, 0.002], (count - 1, 6))
    steps = invert_pose(true[:-1]) @ true[1:] @ exp_se3(off)
    drifted = [true[0]]
    for step in steps:
        drifted.append(drifted[-1] @ step)
    return scans, true, np.array(drifted)


def test_errors_of_an_odometry_do_not_add_up() -> None:
    scans, true, drifted = _drive(22)
    found = refine_path(iter(scans), drifted)
    off_m = np.linalg.norm(found.poses[:, :3, 3] - true[:, :3, 3], axis=1)
    assert np.linalg.norm(drifted[-1, :3, 3] - true[-1, :3, 3]) > 0.1
    assert off_m.max() < 0.03 and found.after_m < 0.02 < found.before_m
    assert np.array_equal(found.poses[0], drifted[0])


def test_rays_that_are_recorded_too_low_do_not_lift_the_path() -> None:
    scans, _, drifted = _drive(14, angle_rad=0.0035)
    found = refine_path(iter(scans), drifted)
    assert found.elevation_rad == pytest.approx(0.0035, abs=0.001)
    assert np.abs(found.poses[:, 2, 3]).max() < 0.05 < np.abs(drifted[:, 2, 3]).max()


def test_along_a_tunnel_the_steps_stay_as_they_were() -> None:
    scans, _, drifted = _drive(14, house_fronts=False)
    found = refine_path(iter(scans), drifted).poses
    steps_m = [np.linalg.norm(np.diff(path[:, :3, 3], axis=0), axis=1) for path in (found, drifted)]
    assert np.abs(steps_m[0] - steps_m[1]).max() < 0.02
    assert abs(steps_m[0].sum() - steps_m[1].sum()) < 0.1


def test_scans_without_surfaces_change_nothing() -> None:
    _, _, drifted = _drive(10)
    rng = np.random.default_rng(1)
    fog = [(rng.uniform(-30.0, 30.0, (300, 3)), np.zeros(300)) for _ in drifted]
    empty = [(np.zeros((0, 3)), np.zeros(0)) for _ in drifted]
    for scans in (fog, empty):
        assert np.array_equal(refine_path(scans, drifted).poses, drifted)
