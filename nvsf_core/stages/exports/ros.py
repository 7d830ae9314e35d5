"""Formats `mcap` and `rosbag2`: a ROS 2 bag in an MCAP file or, as older tools want it, in an SQLite one.

For `ros2 bag play`, Foxglove and Lichtblick.

Topics: `/lidar/points` (PointCloud2 with x, y, z, intensity, ring, time, support),
`/<camera>/image/compressed` (PNG), `/<camera>/depth/image` (32FC1, metres along the optical axis, of a
fisheye along the ray, 0 = not known), `/<camera>/instance/image` (32SC1, object, 0 = none) and
`/<camera>/camera_info`, `/tf` (`world` to `lidar`, at each stamp) and
`/tf_static` (`lidar` to the cameras). Written by `rosbags`, an extra.
"""

import importlib
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from nvsf_core.drives.kitti360.writer import png_bytes
from nvsf_core.errors import MissingLibraryError
from nvsf_core.geometry.fisheye import MeiFisheye
from nvsf_core.stages.exports.records import CameraRecord, DataSet, ScanRecord

MCAP_FOLDER, ROSBAG2_FOLDER = "mcap", "rosbag2"
POINT = np.dtype([
    ("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2"), ("time", "<f4"),
    ("support", "u1"),
])  # fmt: skip
"""One point as it is stored; `time` is seconds after the stamp."""
_KINDS = {"<f4": 7, "<u2": 4, "|u1": 2}
"""PointField's numbers of types."""
_METADATA_VERSION = 8
"""The newest that ROS 2 Humble reads, too: from 9 on, what a topic offers is a list, which it refuses."""
_LATCHED = "/tf_static"
"""Topic whose only message reaches those who subscribe later, too."""


def require_rosbags() -> Any:
    """The module `rosbags.rosbag2`.

    Raises:
        MissingLibraryError: It is not installed; the message says how.
    """
    try:
        return importlib.import_module("rosbags.rosbag2")
    except ImportError as error:
        raise MissingLibraryError(
            "exports: the formats mcap and rosbag2 need the package rosbags: pip install 'nvsf[exports]'"
        ) from error


def write_mcap(folder: Path, data: DataSet) -> None:
    """Write a data set as a bag in an MCAP file.

    Raises:
        MissingLibraryError: `rosbags` is not installed.
    """
    _write(folder / MCAP_FOLDER, "MCAP", data)


def write_rosbag2(folder: Path, data: DataSet) -> None:
    """Write a data set as a bag in an SQLite file (`.db3`).

    Raises:
        MissingLibraryError: `rosbags` is not installed.
    """
    _write(folder / ROSBAG2_FOLDER, "SQLITE3", data)


def _write(folder: Path, storage: str, data: DataSet) -> None:
    """Write a bag, a frame at a time."""
    rosbag2 = require_rosbags()
    bag = rosbag2.Writer(folder, version=_METADATA_VERSION, storage_plugin=rosbag2.StoragePlugin[storage])
    with bag:
        out = _Bag(bag, data.origin_s)
        first_s = float(data.stamp_s[0])
        mounts = [("lidar", name, camera.in_lidar) for name, camera in data.cameras.items()]
        if mounts:
            out.write(_LATCHED, out.transforms(first_s, mounts), first_s)
        for index, stamp_s in enumerate(data.stamp_s.tolist()):
            out.write(
                "/tf", out.transforms(stamp_s, [("world", "lidar", data.lidar_to_world[index])]), stamp_s
            )
            if data.scan is not None:
                out.write("/lidar/points", out.cloud(data.scan(index)), stamp_s)
            for name, camera in data.cameras.items():
                out.write(f"/{name}/camera_info", out.camera_info(name, camera, stamp_s), stamp_s)
                image = data.image(name, index)
                out.write(f"/{name}/image/compressed", out.image(name, image.rgb, stamp_s), stamp_s)
                depth = out.numbers(name, image.depth_m, "32FC1", stamp_s)
                out.write(f"/{name}/depth/image", depth, stamp_s)
                if image.object_id is not None:
                    objects = out.numbers(name, image.object_id, "32SC1", stamp_s)
                    out.write(f"/{name}/instance/image", objects, stamp_s)


class _Bag:
    """Makes ROS 2 messages and writes them; one connection a topic."""

    def __init__(self, bag: Any, origin_s: float) -> None:
        typesys = importlib.import_module("rosbags.typesys")
        self._store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        self._bag = bag
        self._origin_ns = round(origin_s * 1e9)
        self._topics: dict[str, Any] = {}

    def write(self, topic: str, message: Any, stamp_s: float) -> None:
        kind = message.__msgtype__
        if topic not in self._topics:
            offered = [self._latched()] if topic == _LATCHED else []
            self._topics[topic] = self._bag.add_connection(
                topic, kind, typestore=self._store, offered_qos_profiles=offered
            )
        time_ns = self._nanoseconds(stamp_s)
        self._bag.write(self._topics[topic], time_ns, self._store.serialize_cdr(message, kind))

    def _nanoseconds(self, stamp_s: float) -> int:
        return self._origin_ns + round(stamp_s * 1e9)

    @staticmethod
    def _latched() -> Any:
        """What listeners of fixed transforms ask for; `ros2 bag play` offers what stands in the bag."""
        kinds = importlib.import_module("rosbags.interfaces")
        unset = kinds.QosTime(0, 0)
        return kinds.Qos(
            history=kinds.QosHistory.KEEP_LAST, depth=1, reliability=kinds.QosReliability.RELIABLE,
            durability=kinds.QosDurability.TRANSIENT_LOCAL, deadline=unset, lifespan=unset,
            liveliness=kinds.QosLiveliness.SYSTEM_DEFAULT, liveliness_lease_duration=unset,
            avoid_ros_namespace_conventions=False,
        )  # fmt: skip

    def _new(self, kind: str, **values: Any) -> Any:
        return self._store.types[kind](**values)

    def _header(self, stamp_s: float, frame: str) -> Any:
        seconds, rest = divmod(self._nanoseconds(stamp_s), 1_000_000_000)
        stamp = self._new("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest)
        return self._new("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def transforms(self, stamp_s: float, given: list[tuple[str, str, np.ndarray]]) -> Any:
        """Transforms, each of a child's frame (4, 4) in its parent's."""
        found = []
        for parent, child, pose in given:
            x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
            place = dict(zip("xyz", pose[:3, 3].tolist(), strict=True))
            transform = self._new(
                "geometry_msgs/msg/Transform",
                translation=self._new("geometry_msgs/msg/Vector3", **place),
                rotation=self._new("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
            )
            found.append(
                self._new(
                    "geometry_msgs/msg/TransformStamped", header=self._header(stamp_s, parent),
                    child_frame_id=child, transform=transform,
                )
            )  # fmt: skip
        return self._new("tf2_msgs/msg/TFMessage", transforms=found)

    def cloud(self, scan: ScanRecord) -> Any:
        points = points_of(scan)
        fields = [
            self._new(
                "sensor_msgs/msg/PointField", name=name, offset=POINT.fields[name][1],
                datatype=_KINDS[POINT[name].str], count=1,
            )
            for name in POINT.names or () if POINT.fields is not None
        ]  # fmt: skip
        return self._new(
            "sensor_msgs/msg/PointCloud2", header=self._header(scan.stamp_s, "lidar"), height=1,
            width=len(points), fields=fields, is_bigendian=False, point_step=POINT.itemsize,
            row_step=POINT.itemsize * len(points), data=np.frombuffer(points.tobytes(), np.uint8),
            is_dense=True,
        )  # fmt: skip

    def image(self, camera: str, rgb: np.ndarray, stamp_s: float) -> Any:
        data = np.frombuffer(png_bytes(rgb), np.uint8)
        header = self._header(stamp_s, camera)
        return self._new("sensor_msgs/msg/CompressedImage", header=header, format="png", data=data)

    def numbers(self, camera: str, values: np.ndarray, encoding: str, stamp_s: float) -> Any:
        """An image of numbers (H, W), four bytes each."""
        height, width = values.shape
        return self._new(
            "sensor_msgs/msg/Image", header=self._header(stamp_s, camera), height=height, width=width,
            encoding=encoding, is_bigendian=0, step=4 * width,
            data=np.frombuffer(values.astype(f"<{values.dtype.kind}4").tobytes(), np.uint8),
        )  # fmt: skip

    def camera_info(self, name: str, camera: CameraRecord, stamp_s: float) -> Any:
        model = camera.model
        matrix = model.matrix
        # ROS has no MEI model: its numbers stand under its own name, xi first.
        is_mei = isinstance(model, MeiFisheye)
        lens = (
            [model.xi, model.k1, model.k2, model.p1, model.p2] if isinstance(model, MeiFisheye) else [0.0] * 5
        )
        region = self._new(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        return self._new(
            "sensor_msgs/msg/CameraInfo", header=self._header(stamp_s, name), height=model.height,
            width=model.width, distortion_model="mei" if is_mei else "plumb_bob", d=np.array(lens),
            k=matrix.ravel(), r=np.eye(3).ravel(), p=np.column_stack([matrix, np.zeros(3)]).ravel(),
            binning_x=0, binning_y=0, roi=region,
        )  # fmt: skip


def points_of(scan: ScanRecord) -> np.ndarray:
    """A scan's returns (N,) as `POINT`."""
    points = np.zeros(len(scan.rows), POINT)
    for column, name in enumerate(("x", "y", "z", "intensity")):
        points[name] = scan.rows[:, column]
    points["ring"], points["time"], points["support"] = scan.ring, scan.offset_s, scan.support
    return points
