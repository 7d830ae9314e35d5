"""Poses that are read by the wrong convention are told by the scans, which agree by the right one."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nvsf_core.stages.checks.registration import other_reading
from tests.stages.checks.test_registration import bend, hall

OFFSET_M = (4.56e5, 5.412e6, 310.0)


def _drive(made, heading_deg):
    """Points of six scans in the LiDAR's frame, 1 in 8, and their right poses in a world as UTM's."""
    arrays, poses = made
    ends_m = arrays["origin_m"] + arrays["direction"] * arrays["range_m"][:, None]
    scans_m = np.split(ends_m, arrays["offsets"][1:-1])
    points_m = [
        (one[::8] - pose[:3, 3]) @ pose[:3, :3] for one, pose in zip(scans_m, poses, strict=True)
    ]  # fmt: skip
    to_world = np.eye(4)
    to_world[:3, :3] = Rotation.from_euler("z", heading_deg, degrees=True).as_matrix()
    to_world[:3, 3] = OFFSET_M
    return points_m, to_world @ poses


def _with_order(poses, order):
    """The poses as they are read where each quaternion was written in this order of x, y, z, w."""
    found = poses.copy()
    written = Rotation.from_matrix(poses[:, :3, :3]).as_quat()[:, order]
    found[:, :3, :3] = Rotation.from_quat(written).as_matrix()
    return found


@pytest.mark.parametrize("heading_deg", [40.0, 140.0, -95.0])
def test_quaternions_in_another_order_and_inverted_poses_are_told(heading_deg):
    points_m, poses = _drive(hall(12.0, [0, 1, 2, 3, 4, 5]), heading_deg)
    assert other_reading(points_m, poses) == ""
    assert "taken as w, x, y, z" in other_reading(points_m, _with_order(poses, [3, 0, 1, 2]))
    assert "taken as y, z, w, x" in other_reading(points_m, _with_order(poses, [1, 2, 3, 0]))
    points_m, poses = _drive(bend(80.0, 32), heading_deg)
    assert "inverted" in other_reading(points_m, np.linalg.inv(poses))


@pytest.mark.parametrize(
    ("axes", "words"),
    [([1.0, -1.0, 1.0], "y points right: write"), ([1.0, -1.0, -1.0], "y points right, their z down: write")],
    ids=["left-handed", "z down"],
)  # fmt: skip
def test_scans_of_other_axes_are_told_where_the_drive_bends(axes, words):
    points_m, poses = _drive(bend(80.0, 32), 40.0)
    # Pitch of the vehicle: motion on a plane is the same whichever way z points.
    pitch = Rotation.from_euler("y", np.array([0.0, 2.0, 4.0, 3.0, 1.0, -1.0])[:, None], degrees=True)
    turned = pitch.as_matrix()
    poses[:, :3, :3] = poses[:, :3, :3] @ turned
    points_m = [one @ turn for one, turn in zip(points_m, turned, strict=True)]
    assert other_reading(points_m, poses) == ""
    assert words in other_reading([one * axes for one in points_m], poses)


def test_right_poses_in_a_tunnel_that_bends_and_noisy_ones_are_read_as_they_are():
    assert other_reading(*_drive(bend(80.0, 32), 20.0)) == ""
    points_m, poses = _drive(hall(12.0, [0, 1, 2, 3, 4, 5]), 20.0)
    poses[:, :3, 3] += np.random.default_rng(0).normal(0.0, 0.3, (6, 3))
    assert other_reading(points_m, poses) == ""
