"""Laws of the boxes of moving objects."""

import numpy as np
import pytest

from nvsf_core.evidence.moving.object_evidence import smallest_box
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
