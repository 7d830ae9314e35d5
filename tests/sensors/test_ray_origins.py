"""A cloud of two LiDARs, or of one in another frame, is refused with what it is and what to do."""

import numpy as np
import pytest

from nvsf_core.demo.lidar import simulate_scan
from nvsf_core.demo.world import DemoWorld
from nvsf_core.errors import DataError
from nvsf_core.geometry.se3 import exp_so3
from nvsf_core.sensors.found_table import find_table
from nvsf_core.sensors.ray_origins import origin_words

LASERS = np.arange(0, 64, 2)


@pytest.fixture(scope="module")
def scans():
    world = DemoWorld(0)
    return [simulate_scan(world, frame, LASERS, 700) for frame in (0, 4, 8)]


def _mounted(points_m, yaw_rad, place_m):
    return (points_m @ exp_so3(np.array([0.0, 0.0, yaw_rad])).T + place_m).astype(np.float32)


@pytest.mark.parametrize("other_rings", [0, 32], ids=["numbered alike", "numbered on"])
def test_a_cloud_of_two_sensors_is_said_to_be_one(scans, other_rings):
    merged = []
    for one in scans:
        left, right = (_mounted(one.points_m, side, [0.3, 0.7 * np.sign(side), 0.0]) for side in (0.3, -0.3))
        merged.append((np.concatenate([left, right]), np.concatenate([one.laser, one.laser + other_rings])))
    with pytest.raises(
        DataError, match=r"from places 1\.4 m apart: .* more than one sensor; give each sensor's"
    ):
        find_table(merged)


def test_a_cloud_in_the_cars_frame_is_said_to_be_one(scans):
    moved = [(_mounted(one.points_m, 0.3, [1.2, 0.0, 1.7]), one.laser) for one in scans]
    with pytest.raises(
        DataError, match=r"its rays meet in \[1\.2, .* not in the origin: give the points of o"
    ):
        find_table(moved)


def test_rays_of_one_sensor_in_its_own_frame_raise_no_doubt(scans):
    points_m = np.concatenate([one.points_m for one in scans]).astype(np.float64)
    ring = np.concatenate([one.laser for one in scans])
    scan = np.repeat(np.arange(3), [len(one.points_m) for one in scans])
    rows = np.column_stack([points_m, scan])
    assert origin_words([rows[ring == one] for one in range(32)]) == ""
    assert origin_words([]) == "" and origin_words([rows[:50]]) == ""


def test_points_without_rings_or_order_are_asked_for_one_sensors(scans):
    rng = np.random.default_rng(0)
    merged = [np.concatenate([one.points_m, _mounted(one.points_m, 0.5, [0.0, 1.4, 0.0])]) for one in scans]
    with pytest.raises(DataError, match=r"from places 1\.4 m apart"):
        find_table([(points_m, None) for points_m in merged])
    with pytest.raises(
        DataError, match="one scan of one rotating LiDAR, in its own frame, not merged with ano"
    ):
        find_table([(rng.permutation(points_m), None) for points_m in merged])
