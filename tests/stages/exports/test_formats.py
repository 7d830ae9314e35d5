"""Each format, read back by another reader than its writer."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from nvsf_core.clouds.laz import write_laz
from nvsf_core.drives.entries import SceneEntry
from nvsf_core.drives.kitti360.boxes import read_boxes
from nvsf_core.drives.kitti360.calibration import read_calibration
from nvsf_core.drives.kitti360.frames import frame_times, read_poses
from nvsf_core.drives.kitti360.layout import DriveLayout
from nvsf_core.drives.kitti360.source import Kitti360Drive
from nvsf_core.drives.kitti360.writer import UNDATED_S
from nvsf_core.errors import DataError
from nvsf_core.geometry.se3 import invert_pose, transform_points
from nvsf_core.stages.exports.kitti import kitti_cameras, write_kitti
from nvsf_core.stages.exports.kitti360 import object_numbers, write_kitti360
from nvsf_core.stages.exports.nuscenes import VERSION, write_nuscenes
from nvsf_core.stages.exports.records import CameraRecord, DataSet
from nvsf_core.stages.exports.ros import POINT, write_mcap, write_rosbag2
from nvsf_core.stages.views.instances import boxes_at
from tests.stages.exports import small_data_set as small

MCAP_READER = "written by rosbags and read by mcap-ros2-support, of which one is not installed"
LAZ = "laspy or lazrs is not installed"


def test_kitti_is_read_as_odometry_loaders_read_it(tmp_path: Path) -> None:
    write_kitti(tmp_path, small.data_set())
    place = tmp_path / "kitti/sequences/00"
    calib = dict(line.split(": ") for line in (place / "calib.txt").read_text().splitlines())
    lidar_to_camera = np.vstack([np.fromstring(calib["Tr"], sep=" ").reshape(3, 4), [0, 0, 0, 1]])
    poses = np.loadtxt(tmp_path / "kitti/poses/00.txt").reshape(-1, 3, 4)
    assert np.allclose(poses[0], np.eye(4)[:3], atol=1e-9)
    # KISS-ICP turns camera poses into the LiDAR's by Tr: steps must be those that were asked for.
    for k in range(1, small.COUNT):
        whole = np.vstack([poses[k], [0, 0, 0, 1]])
        step = invert_pose(lidar_to_camera) @ whole @ lidar_to_camera
        assert np.allclose(step, invert_pose(small.POSES[0]) @ small.POSES[k], atol=1e-6)
    assert np.allclose(np.loadtxt(place / "times.txt"), small.STAMPS - small.STAMPS[0])
    rows = np.fromfile(place / "velodyne/000001.bin", "<f4").reshape(-1, 4)
    assert (rows == small.scan(1).rows).all()
    assert (np.fromfile(place / "velodyne_ring/000001.bin", "<u2") == small.scan(1).ring).all()
    picture = cv2.imread(str(place / "image_2/000002.png"))[..., ::-1]
    assert (picture == small.image("image_00", 2).rgb).all()
    # P2 projects what the LiDAR sees to where the camera sees it.
    projection = np.fromstring(calib["P2"], sep=" ").reshape(3, 4)
    point_m = np.array([[10.0, 1.0, 0.5]])
    u, v, depth = (projection @ np.append(transform_points(lidar_to_camera, point_m)[0], 1.0)).tolist()
    expected, inside = small.PINHOLE.project(transform_points(invert_pose(small.IN_LIDAR), point_m))
    assert inside[0] and np.allclose([u / depth, v / depth], expected[0], atol=1e-6)


@pytest.mark.parametrize(
    ("rig", "folders"),
    [
        (small.rig(back=180.0, front=0.0, left=90.0), {"front": "image_2"}),
        (small.rig(back=180.0, left=0.2, right=0.0), {"left": "image_2", "right": "image_3"}),
        (small.rig(image_00=0.0, image_02=90.0), {"image_00": "image_2"}),
        (small.rig(image_00=0.0, image_01=0.0, image_02=0.0), {"image_00": "image_2", "image_01": "image_3"}),
        (small.rig(image_02=0.0, image_03=0.0), {"image_02": "image_2", "image_03": "image_3"}),
        (small.rig(image_02=90.0), {"image_02": "image_2"}),
    ],
    ids=["ahead", "a pair", "KITTI-360", "KITTI", "KITTI in colour", "one fisheye"],
)
def test_kittis_cameras_are_the_one_ahead_and_one_beside_it(
    rig: dict[str, CameraRecord], folders: dict[str, str], tmp_path: Path
) -> None:
    assert kitti_cameras(rig) == folders
    write_kitti(tmp_path, replace(small.data_set(), cameras=rig))
    place = tmp_path / "kitti/sequences/00"
    assert sorted(path.name for path in place.glob("image_*")) == list(folders.values())
    # pykitti takes P3 for K [I | t]: its left part must be a camera's matrix.
    calib = dict(line.split(": ") for line in (place / "calib.txt").read_text().splitlines())
    left = np.fromstring(calib["P3"], sep=" ").reshape(3, 4)[:, :3]
    assert np.allclose(left, small.PINHOLE.matrix, atol=1.0)


def test_kitti360_is_read_with_calibration_poses_times_and_boxes(tmp_path: Path) -> None:
    data = small.data_set()
    write_kitti360(tmp_path, data)
    layout = DriveLayout(tmp_path / "kitti360", data.sequence)
    calibration = read_calibration(layout, None, has_scans=True)
    camera = calibration.cameras["image_00"]
    assert camera.intrinsics == small.PINHOLE
    in_lidar = invert_pose(calibration.lidar_to_pose) @ camera.to_pose
    assert np.allclose(in_lidar, small.IN_LIDAR, atol=1e-9)
    poses = read_poses(layout.poses_path)
    for index, number in enumerate(small.NUMBERS):
        assert np.allclose(poses[number] @ calibration.lidar_to_pose, small.POSES[index], atol=1e-9)
        rows = np.fromfile(layout.scan_path(number), "<f4").reshape(-1, 4)
        assert (rows == small.scan(index).rows).all()
    times = frame_times(layout, 4, 7, None)
    assert np.allclose(times.time_s[[0, 1, 3]], small.STAMPS - small.STAMPS[0], atol=1e-6)
    boxes, left_out = read_boxes(layout.boxes_path("train"), 4, 7)
    assert left_out == []
    moving = {row.frame: row for row in boxes if row.dynamic}
    assert {row.object_id for row in boxes} == {26_007, 26_009}, "objects keep their numbers"
    labels = cv2.imread(str(layout.instance_path("image_00", 5)), cv2.IMREAD_UNCHANGED)
    assert labels.dtype == np.uint16 and (labels == small.OBJECT_IDS).all()
    assert np.allclose(moving[5].box_to_world, small.boxes(1)[0].box_to_world, atol=1e-4)


def test_mcap_holds_points_images_cameras_and_transforms(tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason=MCAP_READER)
    factory = pytest.importorskip("mcap_ros2.decoder", reason=MCAP_READER).DecoderFactory()
    reading = pytest.importorskip("mcap.reader", reason=MCAP_READER)
    write_mcap(tmp_path, small.data_set())
    (file,) = (tmp_path / "mcap").glob("*.mcap")
    found: dict[str, list] = {}
    with file.open("rb") as stream:
        reader = reading.make_reader(stream, decoder_factories=[factory])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((message.log_time, decoded))
    assert {topic: len(messages) for topic, messages in found.items()} == {
        "/tf_static": 1, "/tf": 3, "/lidar/points": 3, "/image_00/camera_info": 3,
        "/image_00/image/compressed": 3, "/image_00/depth/image": 3, "/image_00/instance/image": 3,
    }  # fmt: skip
    time_ns, cloud = found["/lidar/points"][2]
    assert time_ns == round(UNDATED_S * 1e9) + 700_000_000 and cloud.header.frame_id == "lidar"
    kinds = {2: "u1", 4: "<u2", 7: "<f4"}
    layout = np.dtype({
        "names": [one.name for one in cloud.fields], "formats": [kinds[one.datatype] for one in cloud.fields],
        "offsets": [one.offset for one in cloud.fields], "itemsize": cloud.point_step,
    })  # fmt: skip
    points, scan = np.frombuffer(bytes(cloud.data), layout), small.scan(2)
    assert np.array_equal(np.column_stack([points[name] for name in ("x", "y", "z", "intensity")]), scan.rows)
    assert (points["ring"] == scan.ring).all() and (points["time"] == scan.offset_s).all()
    assert (points["support"] == scan.support).all()
    _, picture = found["/image_00/image/compressed"][1]
    rgb = cv2.imdecode(np.frombuffer(bytes(picture.data), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert (rgb == small.image("image_00", 1).rgb).all()
    for topic, kind, expected in (
        ("depth", "<f4", small.depth(2)), ("instance", "<i4", small.OBJECT_IDS),
    ):  # fmt: skip
        _, numbers = found[f"/image_00/{topic}/image"][2]
        shown = np.frombuffer(bytes(numbers.data), kind).reshape(numbers.height, numbers.width)
        assert numbers.encoding == {"<f4": "32FC1", "<i4": "32SC1"}[kind] and (shown == expected).all()
    assert np.allclose(np.array(found["/image_00/camera_info"][0][1].k).reshape(3, 3), small.PINHOLE.matrix)
    moved = found["/tf"][1][1].transforms[0].transform.translation
    assert np.allclose([moved.x, moved.y, moved.z], small.POSES[1][:3, 3])


DATES = {"2025-06-15": 1.75e9, "1970-01-01": UNDATED_S}


@pytest.mark.parametrize("date", DATES)
def test_formats_with_dates_have_the_recordings_or_the_first_of_all(tmp_path: Path, date: str) -> None:
    data = replace(small.data_set(), origin_s=DATES[date])
    write_nuscenes(tmp_path, data)
    (log,) = json.loads((tmp_path / "nuscenes" / VERSION / "log.json").read_text())
    samples = json.loads((tmp_path / "nuscenes" / VERSION / "sample.json").read_text())
    assert log["date_captured"] == date
    times_s = np.array([one["timestamp"] for one in samples]) / 1e6
    assert np.allclose(times_s, DATES[date] + small.STAMPS, atol=1e-6)
    write_kitti360(tmp_path, data)
    layout = DriveLayout(tmp_path / "kitti360", data.sequence)
    assert layout.timestamps_path().read_text().startswith(date)
    assert "2013" not in layout.perspective_path.read_text()
    found = frame_times(layout, small.NUMBERS[0], small.NUMBERS[-1], None)
    if DATES[date] == UNDATED_S:
        assert found.origin_s is None
    else:
        assert found.origin_s == pytest.approx(DATES[date] + small.STAMPS[0], abs=1e-5)


def test_a_rosbag2_is_read_by_any_reader_of_rosbags(tmp_path: Path) -> None:
    reading = pytest.importorskip("rosbags.highlevel", reason="rosbags is not installed")
    write_rosbag2(tmp_path, small.data_set())
    assert list((tmp_path / "rosbag2").glob("*.db3"))
    stamps: dict[str, list[int]] = {}
    with reading.AnyReader([tmp_path / "rosbag2"]) as bag:
        for connection, time_ns, raw in bag.messages():
            message = bag.deserialize(raw, connection.msgtype)
            stamps.setdefault(connection.topic, []).append(time_ns)
            if connection.topic == "/lidar/points":
                scan = small.scan(len(stamps["/lidar/points"]) - 1)
                points = np.frombuffer(message.data.tobytes(), POINT)
                assert np.array_equal(np.column_stack([points[name] for name in "xyz"]), scan.rows[:, :3])
                assert (points["ring"] == scan.ring).all() and (points["support"] == scan.support).all()
    assert len(stamps) == 7
    assert stamps["/tf"] == [round(UNDATED_S * 1e9) + round(one * 1e9) for one in small.STAMPS]


@pytest.mark.parametrize(
    ("write", "name"), [(write_mcap, "mcap"), (write_rosbag2, "rosbag2")], ids=["mcap", "rosbag2"]
)
def test_fixed_transforms_reach_who_subscribes_after_they_were_played(
    write: Callable[[Path, DataSet], None], name: str, tmp_path: Path
) -> None:
    reading = pytest.importorskip("rosbags.highlevel", reason="rosbags is not installed")
    write(tmp_path, small.data_set())
    with reading.AnyReader([tmp_path / name]) as bag:
        offered = {one.topic: one.ext.offered_qos_profiles for one in bag.connections}
    assert [(one.durability.name, one.depth) for one in offered.pop("/tf_static")] == [("TRANSIENT_LOCAL", 1)]
    assert not any(offered.values()), "others are as `ros2 bag play` plays them"


@pytest.mark.parametrize(
    ("write", "name"), [(write_mcap, "mcap"), (write_rosbag2, "rosbag2")], ids=["mcap", "rosbag2"]
)
def test_a_bags_metadata_is_as_humble_reads_it(
    write: Callable[[Path, DataSet], None], name: str, tmp_path: Path
) -> None:
    pytest.importorskip("rosbags", reason="rosbags is not installed")
    write(tmp_path, small.data_set())
    facts = yaml.safe_load((tmp_path / name / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert facts["version"] <= 8
    offered = {
        row["topic_metadata"]["name"]: row["topic_metadata"]["offered_qos_profiles"]
        for row in facts["topics_with_message_count"]
    }
    # Humble takes a text of each topic; in it, numbers stand for policies: 1 is transient local.
    assert {type(one) for one in offered.values()} == {str}
    assert yaml.safe_load(offered["/tf_static"])[0]["durability"] == 1


def test_laz_holds_ring_time_and_support(tmp_path: Path) -> None:
    laspy = pytest.importorskip("laspy", reason=LAZ)
    pytest.importorskip("lazrs", reason=LAZ)
    scan = small.scan(0)
    write_laz(tmp_path / "a.laz", scan.rows, scan.ring, scan.offset_s, scan.support)
    cloud = laspy.read(tmp_path / "a.laz")
    assert np.allclose(cloud.xyz, scan.rows[:, :3], atol=6e-5)
    assert np.allclose(cloud.intensity / 65535.0, scan.rows[:, 3], atol=1e-5)
    assert (cloud.ring == scan.ring).all() and (cloud.support == scan.support).all()
    assert (np.asarray(cloud.time) == scan.offset_s).all()
    # LAS 1.4 asks for both; copc-lib refuses files without the first.
    assert cloud.header.global_encoding.wkt and (np.asarray(cloud.return_number) == 1).all()


def test_boxes_between_frames_lie_between_and_end_with_their_track() -> None:
    def row(frame: int, x_m: float, dynamic: bool = True) -> dict:
        pose = np.eye(4)
        pose[0, 3] = x_m
        return {
            "time_s": 0.1 * frame, "object_id": 1 if dynamic else 2, "label": "car", "dynamic": dynamic,
            "box_to_world": pose.ravel().tolist(),
        }  # fmt: skip

    rows = [row(3, 1.0), row(4, 3.0), row(-1, 9.0, dynamic=False)]
    at, times_s = boxes_at(rows), (0.3, 0.35, 0.4, 0.5)
    moving = [[box.box_to_world[0, 3] for box in at(time_s) if box.is_dynamic] for time_s in times_s]
    assert [np.round(one, 9).tolist() for one in moving] == [[1.0], [2.0], [3.0], []]
    assert all(len([box for box in at(time_s) if not box.is_dynamic]) == 1 for time_s in times_s)


def test_kitti360_numbers_an_object_alike_in_boxes_and_images() -> None:
    kept = {26_006: "car", 24_001: "person"}
    assert object_numbers(kept) == dict(zip(kept, kept, strict=True))
    found = object_numbers({5: "car", 1005: "car", 26_006: "car", 26_007: "no class of theirs"})
    assert len(set(found.values())) == 4 and max(found.values()) < 2**16
    assert found[26_006] == 26_006 and found[5] == 26_005 and found[1005] // 1000 == 26
    assert found[26_007] // 1000 != 26
    with pytest.raises(DataError, match="at most 1000 objects of the class 'car'"):
        object_numbers(dict.fromkeys(range(1001), "car"))


def test_kitti360_has_the_images_of_cameras_of_other_names(tmp_path: Path) -> None:
    data = small.data_set()
    named = replace(
        data, cameras={"front": data.cameras["image_00"]},
        image=lambda camera, index: data.image({"front": "image_00"}[camera], index),
    )  # fmt: skip
    write_kitti360(tmp_path, named)
    layout = DriveLayout(tmp_path / "kitti360", data.sequence)
    assert all(layout.image_path("image_00", number).is_file() for number in data.numbers)


def test_kitti360_without_camera_0_is_read_as_a_drive(tmp_path: Path) -> None:
    data = small.data_set()
    right = replace(data, cameras={"image_01": data.cameras["image_00"]})
    write_kitti360(tmp_path, right)
    scene = SceneEntry(
        name="right", root=tmp_path / "kitti360", sequence=data.sequence, first_frame=4, last_frame=7,
        test_frames=(),
    )  # fmt: skip
    facts = Kitti360Drive(scene).facts()
    np.testing.assert_allclose(facts.poses[5] @ facts.calibration.lidar_to_pose, data.lidar_to_world[1])
    camera = facts.calibration.cameras["image_01"]
    in_lidar = invert_pose(facts.calibration.lidar_to_pose) @ camera.to_pose
    np.testing.assert_allclose(in_lidar, small.IN_LIDAR, atol=1e-9)
