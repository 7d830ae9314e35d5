"""Data sets as KISS-ICP's own loaders read them; they come with the extra `odometry`."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from nvsf_core.geometry.se3 import invert_pose
from nvsf_core.stages.exports.kitti import write_kitti
from nvsf_core.stages.exports.records import DataSet
from nvsf_core.stages.exports.ros import write_mcap, write_rosbag2
from tests.stages.exports import small_data_set as small

ABSENT = "the extra `odometry` is not installed"


def test_the_odometry_tree(tmp_path: Path) -> None:
    loaders = pytest.importorskip("kiss_icp.datasets.kitti", reason=ABSENT)
    write_kitti(tmp_path, small.data_set())
    drive = loaders.KITTIOdometryDataset(tmp_path / "kitti", 0)
    assert len(drive) == small.COUNT
    for number in range(small.COUNT):
        points_m, _ = drive[number]
        # It turns points up by KITTI's 0.205 degrees; ranges stay.
        np.testing.assert_allclose(
            np.linalg.norm(points_m, axis=1),
            np.linalg.norm(small.scan(number).rows[:, :3], axis=1),
            rtol=1e-5,
        )
        step = invert_pose(small.POSES[0]) @ small.POSES[number]
        np.testing.assert_allclose(drive.gt_poses[number], step, atol=1e-5)
    np.testing.assert_allclose(drive.get_frames_timestamps()[:, 0], small.STAMPS - small.STAMPS[0])


@pytest.mark.parametrize(("write", "name"), [(write_mcap, "mcap"), (write_rosbag2, "rosbag2")])
def test_bags(write: Callable[[Path, DataSet], None], name: str, tmp_path: Path) -> None:
    # Its other loader of MCAP reads no fields by present versions of mcap-ros2-support.
    for needed in ("kiss_icp", "natsort", "rosbags"):
        pytest.importorskip(needed, reason=ABSENT)
    loaders = pytest.importorskip("kiss_icp.datasets.rosbag", reason=ABSENT)
    write(tmp_path, small.data_set())
    bag = loaders.RosbagDataset(tmp_path / name, topic="/lidar/points")
    assert len(bag) == small.COUNT
    for number in range(small.COUNT):
        points_m, times = bag[number]
        np.testing.assert_array_equal(points_m, small.scan(number).rows[:, :3])
        np.testing.assert_array_equal(times, small.scan(number).offset_s)
    del bag  # it closes the file
