import numpy as np
import pytest
from scipy.linalg import expm

from nvsf_core.errors import ShapeError
from nvsf_core.geometry.se3 import (
    exp_se3,
    exp_so3,
    invert_pose,
    log_se3,
    log_so3,
    pose_from_parts,
    poses_in,
    transform_points,
)

ANGLES_RAD = (0.0, 1e-12, 1e-8, 1e-5, 9.99e-4, 1.01e-3, 0.1, 1.0, 3.0, np.pi - 1e-6, np.pi - 1e-9)


def _twists(angle_rad: float, count: int = 200) -> np.ndarray:
    rng = np.random.default_rng(0)
    twist = rng.normal(size=(count, 6))
    twist[:, 3:] *= angle_rad / np.linalg.norm(twist[:, 3:], axis=1, keepdims=True)
    return twist


@pytest.mark.parametrize("angle_rad", ANGLES_RAD)
def test_log_inverts_exp_at_any_angle(angle_rad):
    twist = _twists(angle_rad)
    np.testing.assert_allclose(log_se3(exp_se3(twist)), twist, atol=1e-12)


@pytest.mark.parametrize("angle_rad", [*ANGLES_RAD, np.pi])
def test_exp_inverts_log_at_any_angle(angle_rad):
    pose = exp_se3(_twists(angle_rad))
    np.testing.assert_allclose(exp_se3(log_se3(pose)), pose, atol=1e-12)


@pytest.mark.parametrize("angle_rad", ANGLES_RAD)
def test_exp_matches_the_matrix_exponential(angle_rad):
    for x, y, z, a, b, c in _twists(angle_rad, 10):
        generator = np.array([[0, -c, b, x], [c, 0, -a, y], [-b, a, 0, z], [0, 0, 0, 0]])
        np.testing.assert_allclose(exp_se3(np.array([x, y, z, a, b, c])), expm(generator), atol=1e-12)


def test_rotations_are_proper_and_agree_with_the_motion():
    twist = _twists(2.0)
    rotation = exp_so3(twist[:, 3:])
    np.testing.assert_allclose(rotation, exp_se3(twist)[:, :3, :3], atol=1e-15)
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0)
    np.testing.assert_allclose(log_so3(rotation), twist[:, 3:], atol=1e-12)


def test_a_quarter_turn_while_driving_follows_a_circle():
    twist = np.array([np.pi / 2 * 10, 0, 0, 0, 0, np.pi / 2])
    path = exp_se3(np.linspace(0, 1, 9)[:, None] * twist)[:, :3, 3]
    np.testing.assert_allclose(np.linalg.norm(path - (0, 10, 0), axis=1), 10.0)


def test_inverse_undoes_a_motion():
    pose = exp_se3(_twists(2.5))
    np.testing.assert_allclose(invert_pose(pose) @ pose, np.broadcast_to(np.eye(4), pose.shape), atol=1e-14)
    points = np.random.default_rng(1).normal(size=(50, 3))
    back = transform_points(invert_pose(pose[0]), transform_points(pose[0], points))
    np.testing.assert_allclose(back, points, atol=1e-14)


def test_poses_in_a_frame_are_found_again_however_far_out_it_lies():
    local = exp_se3(np.random.default_rng(0).normal(size=(50, 6)) * 20.0)
    frame = pose_from_parts(exp_so3(np.array([0.0, 0.0, 2.0])), np.array([5e6, -5e6, 115.0]))
    # Half a float64 step at 5e6 m is 0.47 nm an axis, 0.66 nm of two; a product with the inverse loses more.
    np.testing.assert_allclose(poses_in(frame, frame @ local), local, rtol=0.0, atol=7e-10)


def test_wrong_shapes_are_named():
    with pytest.raises(ShapeError, match=r"\(3, 3\)"):
        log_se3(np.eye(3))
    with pytest.raises(ShapeError, match=r"\(3,\)"):
        exp_se3(np.zeros(3))


def test_empty_input_gives_empty_output():
    assert log_se3(np.zeros((0, 4, 4))).shape == (0, 6)
    assert exp_se3(np.zeros((0, 6))).shape == (0, 4, 4)
