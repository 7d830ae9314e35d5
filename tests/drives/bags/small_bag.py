"""A small ROS 2 bag of some topics: point clouds of given fields, cameras of given K, D and P, one path."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

rosbag2 = pytest.importorskip("rosbags.rosbag2", reason="the extra `rosbags` is not installed")
typesys = pytest.importorskip("rosbags.typesys")

WIDTH, HEIGHT = 64, 48
_STORE = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
_PACKAGES = {"Time": "builtin_interfaces", "Header": "std_msgs", "TFMessage": "tf2_msgs"}
_GEOMETRY = ("Quaternion", "Transform", "TransformStamped", "Vector3")


def new(kind: str, **values: object) -> Any:
    """A message."""
    package = _PACKAGES.get(kind, "geometry_msgs" if kind in _GEOMETRY else "sensor_msgs")
    return _STORE.types[f"{package}/msg/{kind}"](**values)


def header(time_s: float, frame: str) -> Any:
    seconds, rest = divmod(round(time_s * 1e9), 10**9)
    return new("Header", stamp=new("Time", sec=seconds, nanosec=rest), frame_id=frame)


def link(time_s: float, parent: str, child: str, x_m: float) -> Any:
    transform = new(
        "Transform", translation=new("Vector3", x=x_m, y=0.0, z=0.0),
        rotation=new("Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
    )  # fmt: skip
    one = new("TransformStamped", header=header(time_s, parent), child_frame_id=child, transform=transform)
    return new("TFMessage", transforms=[one])


def cloud(time_s: float, frame: str, fields: Sequence[str]) -> Any:
    """20 points, of float32 fields of these names."""
    points = np.random.default_rng(0).uniform(1.0, 9.0, (20, len(fields))).astype("<f4")
    described = [
        new("PointField", name=name, offset=4 * k, datatype=7, count=1) for k, name in enumerate(fields)
    ]
    return new(
        "PointCloud2", header=header(time_s, frame), height=1, width=len(points), fields=described,
        is_bigendian=False, point_step=4 * len(fields), row_step=points.nbytes,
        data=np.frombuffer(points.tobytes(), np.uint8), is_dense=True,
    )  # fmt: skip


def camera(time_s: float, k: Sequence[float], d: Sequence[float], p: Sequence[float]) -> tuple[Any, Any]:
    """A camera info and an image; `k` and `p` as fx, fy, cx, cy."""
    region = new("RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    info = new(
        "CameraInfo", header=header(time_s, "cam"), height=HEIGHT, width=WIDTH,
        distortion_model="plumb_bob", d=np.array(d, np.float64),
        k=np.array([k[0], 0, k[2], 0, k[1], k[3], 0, 0, float(any(k))]), r=np.eye(3).ravel(),
        p=np.array([p[0], 0, p[2], 0, 0, p[1], p[3], 0, 0, 0, float(any(p)), 0]), binning_x=0, binning_y=0,
        roi=region,
    )  # fmt: skip
    pixels = np.random.default_rng(1).integers(0, 255, HEIGHT * WIDTH * 3, np.uint8)
    image = new(
        "Image", header=header(time_s, "cam"), height=HEIGHT, width=WIDTH, encoding="rgb8", is_bigendian=0,
        step=3 * WIDTH, data=pixels,
    )  # fmt: skip
    return info, image


def write_bag(
    folder: Path,
    messages: Sequence[tuple[str, Any, float]],
    *,
    packed: rosbag2.CompressionMode | None = None,
    is_mcap: bool = False,
) -> None:
    """Write (topic, message, seconds) as a bag.

    Args:
        folder: To make.
        messages: In their order.
        packed: How, as `ros2 bag record --compression-mode` says; None = not.
        is_mcap: Whether in MCAP files, or in sqlite's.
    """
    plugin = rosbag2.StoragePlugin.MCAP if is_mcap else rosbag2.StoragePlugin.SQLITE3
    bag = rosbag2.Writer(folder, version=9, storage_plugin=plugin)
    if packed is not None:
        bag.set_compression(packed, rosbag2.CompressionFormat.ZSTD)
    known: dict[str, Any] = {}
    with bag:
        for topic, message, time_s in messages:
            kind = message.__msgtype__
            if topic not in known:
                known[topic] = bag.add_connection(topic, kind, typestore=_STORE)
            bag.write(known[topic], round(time_s * 1e9), _STORE.serialize_cdr(message, kind))


def moving_lidar(scans: int = 4) -> list[tuple[str, Any, float]]:
    """A LiDAR with rings and times that drives, and the mounting of a camera `cam`."""
    messages = [("/tf_static", link(0.0, "lidar", "cam", 0.5), 0.0)]
    for k in range(scans):
        time_s = 1.0 + 0.1 * k
        messages.append(("/tf", link(time_s, "odom", "lidar", 0.5 * k), time_s))
        messages.append(("/velodyne_points", cloud(time_s, "lidar", ["x", "y", "z", "ring"]), time_s))
    return messages
