"""A ROS 1 bag as drivers write it: stamped at the sweep's begin, nanoseconds, rings from below, raw image."""

import numpy as np
import pytest

from nvsf_core.drives.detect import kind_of, whole_drive
from nvsf_core.drives.drive import drive_of
from nvsf_core.drives.validation import read_drive

rosbag1 = pytest.importorskip("rosbags.rosbag1", reason="the extra `rosbags` is not installed")
typesys = pytest.importorskip("rosbags.typesys")

START_S, PERIOD_S, SPEED_M_S, SCANS = 1_600_000_000, 0.1, 5.0, 4
WIDTH, HEIGHT = 64, 48
KIND = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("_", "<f4"), ("intensity", "<f4"), ("t", "<u4"),
                 ("ring", "u1"), ("pad", "u1", (3,))])  # fmt: skip


def _cloud() -> np.ndarray:
    """16 lasers from below, 90 columns; every tenth point did not return."""
    column, ring = np.meshgrid(np.arange(90), np.arange(16), indexing="ij")
    rise, azimuth = np.radians(-15.0 + 2.0 * ring), -2.0 * np.pi * column / 90
    range_m = np.where(ring < 7, np.minimum(-1.8 / np.sin(np.minimum(rise, -0.01)), 40.0), 15.0)
    points = np.zeros(column.size, KIND)
    points["x"] = (range_m * np.cos(rise) * np.cos(azimuth)).ravel()
    points["y"] = (range_m * np.cos(rise) * np.sin(azimuth)).ravel()
    points["z"] = (range_m * np.sin(rise)).ravel()
    points["intensity"], points["ring"] = 200.0, ring.ravel()
    points["t"] = (column.ravel() * PERIOD_S / 90 * 1e9).astype(np.uint32)
    points["x"][::10] = np.nan
    return points


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    path = tmp_path_factory.mktemp("ros1") / "drive.bag"
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
    links = "geometry_msgs/TransformStamped[] transforms\n"
    store.register(typesys.get_types_from_msg(links, "tf2_msgs/msg/TFMessage"))

    def new(kind: str, **values: object) -> object:
        return store.types[kind](**values)

    def header(time_s: float, frame: str) -> object:
        seconds, rest = divmod(round(time_s * 1e9), 10**9)
        stamp = new("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest)
        return new("std_msgs/msg/Header", seq=0, stamp=stamp, frame_id=frame)

    def link(time_s: float, parent: str, child: str, place_m: tuple[float, float, float]) -> object:
        x, y, z = place_m
        turn = new("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
        transform = new(
            "geometry_msgs/msg/Transform", translation=new("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
            rotation=turn,
        )  # fmt: skip
        return new(
            "geometry_msgs/msg/TransformStamped", header=header(time_s, parent), child_frame_id=child,
            transform=transform,
        )  # fmt: skip

    with rosbag1.Writer(path) as writer:
        known: dict[str, object] = {}

        def write(topic: str, message: object, time_s: float) -> None:
            kind = message.__msgtype__
            if topic not in known:
                known[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(known[topic], round(time_s * 1e9), store.serialize_ros1(message, kind))

        fixed = [
            link(START_S, "base", "velodyne", (1.0, 0.0, 1.8)),
            link(START_S, "base", "cam", (1.5, 0.2, 1.5)),
        ]
        write("/tf_static", new("tf2_msgs/msg/TFMessage", transforms=fixed), START_S)
        for k in range(5 * SCANS + 10):
            moment_s = START_S - 0.1 + 0.02 * k
            moved = link(moment_s, "odom", "base", (SPEED_M_S * (moment_s - START_S), 0.0, 0.0))
            write("/tf", new("tf2_msgs/msg/TFMessage", transforms=[moved]), moment_s)
        points, rng = _cloud(), np.random.default_rng(0)
        fields = [
            new(
                "sensor_msgs/msg/PointField", name=name, offset=KIND.fields[name][1], datatype=number, count=1
            )
            for name, number in (("x", 7), ("y", 7), ("z", 7), ("intensity", 7), ("t", 6), ("ring", 2))
        ]
        for k in range(SCANS):
            stamp_s = START_S + k * PERIOD_S
            cloud = new(
                "sensor_msgs/msg/PointCloud2", header=header(stamp_s, "/velodyne"), height=1,
                width=len(points), fields=fields, is_bigendian=False, point_step=KIND.itemsize,
                row_step=KIND.itemsize * len(points), data=np.frombuffer(points.tobytes(), np.uint8),
                is_dense=False,
            )  # fmt: skip
            write("/velodyne_points", cloud, stamp_s + 0.12)
            region = new(
                "sensor_msgs/msg/RegionOfInterest",
                x_offset=0,
                y_offset=0,
                height=0,
                width=0,
                do_rectify=False,
            )
            lens = np.array([-0.1, 0.01, 0.0, 0.0, 0.0])
            matrix = np.array([50.0, 0, 32.0, 0, 50.0, 24.0, 0, 0, 1.0])
            info = new(
                "sensor_msgs/msg/CameraInfo", header=header(stamp_s + 0.04, "cam"), height=HEIGHT,
                width=WIDTH, distortion_model="plumb_bob", D=lens, K=matrix, R=np.eye(3).ravel(),
                P=np.zeros(12), binning_x=0, binning_y=0, roi=region,
            )  # fmt: skip
            write("/front/camera_info", info, stamp_s + 0.05)
            pixels = rng.integers(0, 255, HEIGHT * WIDTH * 3, np.uint8)
            image = new(
                "sensor_msgs/msg/Image", header=header(stamp_s + 0.04, "cam"), height=HEIGHT, width=WIDTH,
                encoding="bgr8", is_bigendian=0, step=3 * WIDTH, data=pixels,
            )  # fmt: skip
            write("/front/image_raw", image, stamp_s + 0.06)
    return path


def test_a_ros_1_bag_is_read_at_the_middle_of_its_sweeps(bag):
    assert kind_of(bag) == "bag"
    scene = whole_drive(bag, "bag")
    assert (scene.first_frame, scene.last_frame) == (0, SCANS - 1)
    drive = drive_of(scene)
    found = read_drive(scene, lambda line: None)
    assert all(row.scan_valid for row in found.frames) and all(row.image_valid for row in found.images)
    assert any("ms before the middle of their sweep" in note for note in found.notes)
    for frame, row in enumerate(found.frames):
        middle_s = frame * PERIOD_S + 0.5 * PERIOD_S * 89 / 90
        assert np.allclose(row.lidar_to_world[:3, 3], [1.0 + SPEED_M_S * middle_s, 0.0, 1.8], atol=0.01)
        image = found.images[frame].camera_to_world[:3, 3]
        assert np.allclose(image, [1.5 + SPEED_M_S * (frame * PERIOD_S + 0.04), 0.2, 1.5], atol=1e-4)
    scan = drive.read_scan(1)
    assert len(scan.points) == 1440 - 144 and scan.n_absurd == 0
    assert np.allclose(scan.points[:, 3], 200.0 / 255.0, atol=1e-6)
    assert abs(scan.offset_s.min() + 0.05) < 2e-3 and abs(scan.offset_s.max() - 0.05) < 2e-3
    assert sorted(np.unique(scan.ring)) == list(range(16))
    lens = found.calibration.cameras["front"].intrinsics
    assert (lens.width, lens.height) == (WIDTH, HEIGHT) and lens.fx != 50.0
