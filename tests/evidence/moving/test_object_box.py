"""Laws of the boxes of moving objects."""

import numpy as np
import pytest

from nvsf_core.evidence.moving.object_evidence import MovingObject, smallest_box, way_ahead
from nvsf_core.geometry.se3 import rotation_of


@pytest.mark.parametrize("yaw_deg", [0.0, 30.0, 100.0, -135.0])
def test_a_box_lies_around_the_points_and_along_the_way(yaw_deg: float) -> None:
    axes, middle_m, size_m = rotation_of(yaw_deg, 0.0, 0.0), np.array([3.0, -1.0, 0.5]), (4.0, 2.0, 1.5)
    corners = np.random.default_rng(0).uniform(-0.5, 0.5, (4000, 3))
    # Two sides are seen, as from a sensor beside a car; a few returns lie far off.
    corners[::2, 0], corners[1::2, 1] = 0.5, -0.5
    corners[:8] *= 5.0
    points = corners * size_m @ axes.T + middle_m
    box = smallest_box(points, 7.0 * axes[:2, 0] + 0.9 * axes[:2, 1])
    np.testing.assert_allclose(np.linalg.norm(box[:3, :3], axis=0), size_m, rtol=0.03)
    np.testing.assert_allclose(box[:3, 3], middle_m, atol=0.05)
    assert box[:3, 0] @ axes[:, 0] > 3.9, "its x axis looks ahead"
    assert np.linalg.det(box[:3, :3]) > 0.0


def test_one_point_has_a_box_that_is_not_flat() -> None:
    box = smallest_box(np.array([[1.0, 2.0, 3.0]]), np.array([1.0, 0.0]))
    np.testing.assert_allclose(np.linalg.norm(box[:3, :3], axis=0), 0.1)
    np.testing.assert_allclose(box[:3, 3], [1.0, 2.0, 3.0])


@pytest.mark.parametrize("turn_deg", [0.0, 60.0, 120.0, 180.0, 270.0])
def test_the_box_of_a_car_that_turns_lies_along_it(turn_deg: float) -> None:
    yaw_rad = np.linspace(0.0, np.radians(turn_deg), 30)
    step_m = np.stack([np.cos(yaw_rad), np.sin(yaw_rad)], axis=1)
    pose = np.zeros((30, 4))
    pose[:, :2], pose[:, 3] = np.cumsum(step_m, axis=0), yaw_rad
    path = MovingObject(
        np.arange(30, dtype=np.int32), 0.1 * np.arange(30), pose, 0.1, np.zeros(3), np.zeros(3)
    )
    corners = np.random.default_rng(0).uniform(-0.5, 0.5, (2000, 3)) * (4.5, 1.8, 1.5)
    box = smallest_box(corners, way_ahead(path))
    np.testing.assert_allclose(np.linalg.norm(box[:3, :3], axis=0), (4.5, 1.8, 1.5), rtol=0.03)
    assert box[0, 0] > 4.0, "its x axis looks ahead"
