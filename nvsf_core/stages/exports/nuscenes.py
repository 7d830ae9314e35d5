"""Format `nuscenes`: the tables and files of the nuScenes data set, version `v1.0-nvsf`.

Every instant is a sample, all its data are key frames. Axes are nuScenes': the LiDAR's x to the right, y
forward; of the vehicle x forward, y left, in the LiDAR's place, since nobody knows the rear axle. Intensity
is 0 to 255. Images are PNG; the pinhole camera that looks ahead is CAM_FRONT, the others are named after
their own names; fisheyes, which the tables cannot describe, are left out. Time and support of points, which
have no column, lie in folders beside. There is no map: its mask is empty.
"""

import hashlib
import itertools
import json
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from nvsf_core.drives.kitti360.scans import write_column
from nvsf_core.drives.kitti360.writer import write_grey, write_image, write_text
from nvsf_core.geometry.boxes import inside_any
from nvsf_core.geometry.se3 import invert_pose
from nvsf_core.stages.exports.camera_places import pinholes_of
from nvsf_core.stages.exports.records import BoxRecord, CameraRecord, DataSet, ScanRecord

FOLDER, VERSION = "nuscenes", "v1.0-nvsf"
LIDAR = "LIDAR_TOP"
TABLES = (
    "attribute", "calibrated_sensor", "category", "ego_pose", "instance", "log", "map", "sample",
    "sample_annotation", "sample_data", "scene", "sensor", "visibility",
)  # fmt: skip
_TO_EGO = np.array([[0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""LiDAR axes of nuScenes (x right, y forward) to the vehicle's (x forward, y left)."""
_CATEGORIES = {
    "car": "vehicle.car", "truck": "vehicle.truck", "bus": "vehicle.bus.rigid", "trailer": "vehicle.trailer",
    "motorcycle": "vehicle.motorcycle", "bicycle": "vehicle.bicycle", "person": "human.pedestrian.adult",
    "pedestrian": "human.pedestrian.adult",
}  # fmt: skip
"""Names of nuScenes; other labels stay as they are."""
_NO_MAP = np.zeros((8, 8), np.uint8)


def nuscenes_channels(cameras: Mapping[str, CameraRecord]) -> dict[str, str]:
    """Camera to its channel; fisheyes have none."""
    pinholes = pinholes_of(cameras)
    # Where a camera is called `front` it is the first: no two have one channel.
    channels = ["CAM_FRONT", *(f"CAM_{name.upper()}" for name in pinholes[1:])]
    return dict(zip(pinholes, channels, strict=False))


def write_nuscenes(folder: Path, data: DataSet) -> None:
    """Write a data set as tables and files of nuScenes, a frame at a time."""
    tables = _Tables(data)
    root = folder / FOLDER
    for index in range(len(data.numbers)):
        scan = None if data.scan is None else data.scan(index)
        if scan is not None:
            _write_scan(root, tables.add_data(LIDAR, index, "pcd"), scan)
        for camera, channel in tables.channels.items():
            image = data.image(camera, index)
            write_image(root / tables.add_data(channel, index, "png"), image.rgb)
        for box in data.boxes(index):
            tables.add_box(index, box, scan)
    write_grey(root / tables.rows["map"][0]["filename"], _NO_MAP, np.uint8)
    for name, rows in tables.finished().items():
        write_text(root / VERSION / f"{name}.json", json.dumps(rows, indent=0, allow_nan=False))


def _write_scan(root: Path, file: str, scan: ScanRecord) -> None:
    """Write x, y, z, intensity, ring as float32; time and support in folders beside."""
    path = root / file
    x, y, z, intensity = scan.rows.T
    write_column(path, np.column_stack([-y, x, z, 255.0 * intensity, scan.ring]).astype("<f4"))
    for name in sorted({*scan.beside} - {"ring"}):
        beside = path.parent.with_name(f"{LIDAR}_{name}") / path.name.replace(".pcd.bin", ".bin")
        write_column(beside, scan.beside[name])


class _Tables:
    """The rows of the tables while a data set is written."""

    def __init__(self, data: DataSet) -> None:
        self._data = data
        self.rows: dict[str, list[dict[str, Any]]] = {name: [] for name in TABLES}
        self.channels = nuscenes_channels(data.cameras)
        self._add_log()
        if data.scan is not None:
            self._add_sensor(LIDAR, "lidar", _TO_EGO, [])
        for name, channel in self.channels.items():
            camera = data.cameras[name]
            matrix = np.asarray(camera.model.matrix).tolist()
            self._add_sensor(channel, "camera", camera.in_lidar, matrix)
        for index, stamp_s in enumerate(data.stamp_s.tolist()):
            self._add_sample(index, self._microseconds(stamp_s))

    def _token(self, *parts: object) -> str:
        """The token of what the parts name: the same in each run."""
        words = "/".join(map(str, (self._data.sequence, self._data.name, *parts)))
        return hashlib.sha256(words.encode()).hexdigest()[:32]

    def _microseconds(self, stamp_s: float) -> int:
        return round(self._data.origin_s * 1e6) + round(stamp_s * 1e6)

    def _add_log(self) -> None:
        data, token = self._data, self._token("log")
        date = datetime.fromtimestamp(data.origin_s, UTC).strftime("%Y-%m-%d")
        self.rows["log"].append(
            {"token": token, "logfile": data.sequence, "vehicle": "synthetic", "date_captured": date,
             "location": data.sequence}
        )  # fmt: skip
        name = self._token("map")
        self.rows["map"].append(
            {"token": name, "log_tokens": [token], "category": "semantic_prior",
             "filename": f"maps/{name}.png"}
        )  # fmt: skip
        self.rows["scene"].append(
            {"token": self._token("scene"), "name": data.name, "log_token": token,
             "description": f"synthetic view {data.name} of {data.sequence}",
             "nbr_samples": len(data.numbers), "first_sample_token": self._token("sample", 0),
             "last_sample_token": self._token("sample", len(data.numbers) - 1)}
        )  # fmt: skip
        self.rows["visibility"].append({"token": "0", "level": "unknown", "description": "not estimated"})

    def _add_sensor(
        self, channel: str, modality: str, to_ego: np.ndarray, intrinsic: list[list[float]] | list[float]
    ) -> None:
        self.rows["sensor"].append(
            {"token": self._token("sensor", channel), "channel": channel, "modality": modality}
        )
        self.rows["calibrated_sensor"].append(
            {"token": self._token("calibrated", channel), "sensor_token": self._token("sensor", channel),
             **_placed(to_ego), "camera_intrinsic": intrinsic}
        )  # fmt: skip

    def _add_sample(self, index: int, time_us: int) -> None:
        self.rows["sample"].append(
            {"token": self._token("sample", index), "timestamp": time_us,
             "scene_token": self._token("scene"), **self._neighbours("sample", index)}
        )  # fmt: skip
        self.rows["ego_pose"].append(
            {"token": self._token("ego", index), "timestamp": time_us,
             **_placed(self._data.lidar_to_world[index])}
        )  # fmt: skip

    def _neighbours(self, *named: object) -> dict[str, str]:
        """Tokens of the instants before and after; empty where there is none."""
        *kind, index = named
        assert isinstance(index, int)
        last = len(self._data.numbers) - 1
        return {
            "prev": self._token(*kind, index - 1) if index > 0 else "",
            "next": self._token(*kind, index + 1) if index < last else "",
        }

    def add_data(self, channel: str, index: int, kind: str) -> str:
        """Add a row of `sample_data`; returns the path of its file below the root."""
        time_us = self._microseconds(float(self._data.stamp_s[index]))
        ending = "pcd.bin" if kind == "pcd" else kind
        file = f"samples/{channel}/{self._data.name}__{channel}__{time_us}.{ending}"
        model = next(
            (self._data.cameras[name].model for name, one in self.channels.items() if one == channel), None
        )
        self.rows["sample_data"].append(
            {"token": self._token("data", channel, index), "sample_token": self._token("sample", index),
             "ego_pose_token": self._token("ego", index),
             "calibrated_sensor_token": self._token("calibrated", channel), "filename": file,
             "fileformat": kind, "is_key_frame": True, "timestamp": time_us,
             "width": 0 if model is None else model.width, "height": 0 if model is None else model.height,
             **self._neighbours("data", channel, index)}
        )  # fmt: skip
        return file

    def add_box(self, index: int, box: BoxRecord, scan: ScanRecord | None) -> None:
        """Add an object of an instant; `scan` is counted in it."""
        centre, size, rotation = _upright(box.box_to_world)
        hits = 0 if scan is None else _points_in(box, scan)
        self.rows["sample_annotation"].append(
            {"token": self._token("box", box.object_id, index), "sample_token": self._token("sample", index),
             "instance_token": self._token("object", box.object_id), "visibility_token": "0",
             "attribute_tokens": [], "translation": centre, "size": size, "rotation": rotation,
             "num_lidar_pts": hits, "num_radar_pts": 0, "prev": "", "next": "", "label": box.label}
        )  # fmt: skip

    def finished(self) -> Mapping[str, list[dict[str, Any]]]:
        """All tables, with instances and categories of the boxes, which are linked."""
        tracks: dict[str, list[dict[str, Any]]] = {}
        for row in self.rows["sample_annotation"]:
            tracks.setdefault(row["instance_token"], []).append(row)
        for token, track in tracks.items():
            for before, after in itertools.pairwise(track):
                before["next"], after["prev"] = after["token"], before["token"]
            label = track[0]["label"]
            self.rows["instance"].append(
                {"token": token, "category_token": self._token("category", label),
                 "nbr_annotations": len(track), "first_annotation_token": track[0]["token"],
                 "last_annotation_token": track[-1]["token"]}
            )  # fmt: skip
        labels = sorted({row.pop("label") for row in self.rows["sample_annotation"]})
        self.rows["category"] = [
            {"token": self._token("category", label), "name": _CATEGORIES.get(label, label), "index": number,
             "description": f"labelled {label} in the recording"}
            for number, label in enumerate(labels, start=1)
        ]  # fmt: skip
        return self.rows


def _points_in(box: BoxRecord, scan: ScanRecord) -> int:
    """Number of a scan's points inside a box."""
    in_lidar = invert_pose(scan.lidar_to_world) @ box.box_to_world
    # Half of the box's diagonal: beyond it no point is looked at twice.
    reach_m = 0.5 * float(np.linalg.norm(in_lidar[:3, :3]))
    near = np.ones(len(scan.rows), np.bool_)
    for axis in range(3):
        near &= np.abs(scan.rows[:, axis] - in_lidar[axis, 3]) <= reach_m
    return int(inside_any(scan.rows[near, :3].astype(np.float64), in_lidar[None]).sum())


def _placed(pose: np.ndarray) -> dict[str, list[float]]:
    return {"translation": pose[:3, 3].tolist(), "rotation": _quaternion(pose[:3, :3])}


def _quaternion(rotation: np.ndarray) -> list[float]:
    """w, x, y, z."""
    x, y, z, w = Rotation.from_matrix(rotation).as_quat().tolist()
    return [w, x, y, z]


def _upright(box_to_world: np.ndarray) -> tuple[list[float], list[float], list[float]]:
    """Centre, size (width, length, height) and rotation of a box; its most upright edge is the height."""
    axes = box_to_world[:3, :3]
    edges_m = np.linalg.norm(axes, axis=0)
    up = int(np.argmax(np.abs(axes[2] / edges_m)))
    # Cyclic: right-handed axes stay so.
    order = [(up + 1) % 3, (up + 2) % 3, up]
    axes, edges_m = axes[:, order] / edges_m[order], edges_m[order]
    if axes[2, 2] < 0.0:
        axes = axes * [1.0, -1.0, -1.0]
    if np.linalg.det(axes) < 0.0:
        axes = axes * [1.0, -1.0, 1.0]
    length_m, width_m, height_m = edges_m.tolist()
    return box_to_world[:3, 3].tolist(), [width_m, length_m, height_m], _quaternion(axes)
