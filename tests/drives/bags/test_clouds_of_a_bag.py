"""Which of several topics of point clouds is the LiDAR's, and how another is taken."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nvsf_core.drives.detect import whole_drive
from nvsf_core.drives.drive import drive_of
from nvsf_core.drives.entries import SceneEntry
from nvsf_core.errors import DataError, NvsfError
from nvsf_core.stages import STAGES, run_scene
from nvsf_core.stages.imports.convert import import_drive
from tests.drives.bags.small_bag import cloud, link, moving_lidar, write_bag

DEPTH = "/camera/depth/points"


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A LiDAR at 10 Hz, and a depth camera at 30 Hz."""
    folder = tmp_path_factory.mktemp("clouds") / "bag"
    times_s = [1.0 + k / 30.0 for k in range(12)]
    depth = [(DEPTH, cloud(time_s, "lidar", ["x", "y", "z", "rgb"]), time_s) for time_s in times_s]
    write_bag(folder, [*moving_lidar(), *depth])
    return folder


def test_clouds_with_rings_come_before_the_more_frequent_of_a_depth_camera(bag: Path) -> None:
    drive = drive_of(whole_drive(bag, "bag"))
    assert len(drive.frames) == 4 and drive.scan_name(0) == "number 0 of /velodyne_points"
    (note,) = drive.facts().calibration.notes
    assert DEPTH in note and "lidar_topic" in note


def test_of_messages_that_were_kept_at_once_each_scan_is_the_one_of_its_stamp(tmp_path: Path) -> None:
    # A simulated clock ticks five times a second: two scans are kept under each of its times.
    messages = [("/tf_static", link(0.0, "lidar", "cam", 0.5), 0.0)]
    for k in range(6):
        stamp_s, kept_s = 1.0 + 0.1 * k, 1.0 + 0.2 * (k // 2)
        one = cloud(stamp_s, "lidar", ["x", "y", "z", "ring"])
        data = one.data.copy()
        data[:4] = np.frombuffer(np.float32(10.0 + k).tobytes(), np.uint8)
        one = replace(one, data=data)
        messages += [("/tf", link(stamp_s, "odom", "lidar", 0.5 * k), kept_s), ("/points", one, kept_s)]
    write_bag(tmp_path / "bag", messages)
    drive = drive_of(whole_drive(tmp_path / "bag", "bag"))
    firsts_m = [float(drive.decode_scan(frame).points[0, 0]) for frame in drive.frames]
    assert firsts_m == [10.0, 11.0, 12.0, 13.0, 14.0, 15.0]


def test_a_topic_may_have_slashes_side_by_side(tmp_path: Path) -> None:
    messages = [
        (name.replace("/velodyne_points", "/top//points"), one, time_s)
        for name, one, time_s in moving_lidar()
    ]
    write_bag(tmp_path / "bag", messages)
    assert len(drive_of(whole_drive(tmp_path / "bag", "bag")).decode_scan(0).points) == 20


def test_a_scene_names_the_topic_of_its_clouds(bag: Path, tmp_path: Path) -> None:
    scene = whole_drive(bag, "bag", lidar_topic=DEPTH)
    assert len(drive_of(scene).frames) == 12
    assert import_drive(scene, tmp_path / "out", progress=str).scans == 12
    with pytest.raises(DataError, match=rf"lidar_topic: expected one of .*{DEPTH}, /velodyne.*found '/none'"):
        whole_drive(bag, "bag", lidar_topic="/none")


def test_clouds_that_are_no_scans_are_refused_with_the_key_that_takes_others(
    bag: Path, tmp_path: Path
) -> None:
    chosen = [stage for stage in STAGES if stage.name in ("frames", "sweeps")]
    with pytest.raises(NvsfError, match=r"lasers: .*not read: /velodyne_points \(`lidar_topic`"):
        run_scene(whole_drive(bag, "bag", lidar_topic=DEPTH), tmp_path, progress=str, stages=chosen)


def test_only_a_bag_has_topics(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="lidar_topic: expected a scene of the kind 'bag', found 'plain'"):
        SceneEntry(
            name="a", root=tmp_path, sequence="a", first_frame=0, last_frame=1, test_frames=(),
            kind="plain", lidar_topic=DEPTH,
        )  # fmt: skip
