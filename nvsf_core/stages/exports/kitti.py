"""Format `kitti`: one sequence of KITTI's odometry benchmark, as most research code reads it.

`sequences/00/velodyne/000000.bin`, `image_2/000000.png` (and `image_3`), `times.txt`, `calib.txt`, and
`poses/00.txt`: camera 0 to its first pose, a 3 x 4 matrix a line. `calib.txt` has `P0` to `P3` of the
cameras and `Tr`, LiDAR to camera 0. Without images the camera is a nominal one in the LiDAR's place. Frames
count from 0. `image_2` is the pinhole camera that looks ahead; `image_3` another one of the same axes, as the
benchmark's readers take all cameras to be rectified to each other; others are left out.

Unlike the benchmark's, scans are not compensated for the car's motion, unless the scene's were.
`velodyne_time`, which only these trees have, holds each point's time after the stamp: 0 of scans of one
instant.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from nvsf_core.drives.kitti.files import CAMERA_AXES_TO_Z_UP
from nvsf_core.drives.kitti360.scans import write_column, write_scan
from nvsf_core.drives.kitti360.writer import write_image, write_text
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.geometry.se3 import invert_pose
from nvsf_core.stages.exports.camera_places import are_parallel, pinholes_of
from nvsf_core.stages.exports.records import CameraRecord, DataSet

FOLDER = "kitti"
_SEQUENCE = "00"
_FIRST = 2
"""KITTI's colour cameras are numbers 2 and 3."""


def kitti_cameras(cameras: Mapping[str, CameraRecord]) -> dict[str, str]:
    """Camera to its folder, `image_2` and, where another has the same axes, `image_3`."""
    pinholes = pinholes_of(cameras)
    rectified = [name for name in pinholes if are_parallel(cameras[name], cameras[pinholes[0]])]
    return dict(zip(rectified, (f"image_{number}" for number in (_FIRST, _FIRST + 1)), strict=False))


def write_kitti(folder: Path, data: DataSet) -> None:
    """Write a data set as one sequence of the odometry benchmark."""
    root = folder / FOLDER
    place = root / "sequences" / _SEQUENCE
    names = list(kitti_cameras(data.cameras))
    in_lidar = data.cameras[names[0]].in_lidar if names else CAMERA_AXES_TO_Z_UP
    camera_to_world = data.lidar_to_world @ in_lidar
    relative = invert_pose(camera_to_world[:1]) @ camera_to_world
    _write(root / "poses" / f"{_SEQUENCE}.txt", [_line(pose[:3]) for pose in relative])
    _write(place / "times.txt", [f"{stamp - data.stamp_s[0]:.6e}" for stamp in data.stamp_s])
    _write(place / "calib.txt", _calibration(data, names, in_lidar))
    for index in range(len(data.numbers)):
        if data.scan is not None:
            scan = data.scan(index)
            write_scan(place / "velodyne" / f"{index:06d}.bin", scan.rows[:, :3], scan.rows[:, 3])
            for name, values in scan.beside.items():
                write_column(place / f"velodyne_{name}" / f"{index:06d}.bin", values)
        for number, name in enumerate(names, start=_FIRST):
            write_image(place / f"image_{number}" / f"{index:06d}.png", data.image(name, index).rgb)


def _calibration(data: DataSet, names: list[str], in_lidar: np.ndarray) -> list[str]:
    """Lines P0 to P3, projections from the first camera's frame, and Tr, LiDAR to that frame."""
    projections = {}
    for number, name in enumerate(names, start=_FIRST):
        model = data.cameras[name].model
        assert isinstance(model, Pinhole)
        from_first = invert_pose(data.cameras[name].in_lidar) @ in_lidar
        projections[number] = model.matrix @ from_first[:3]
    nominal = np.eye(3, 4)
    first = projections.get(_FIRST, nominal)
    lines = [f"P{number}: {_line(projections.get(number, first))}" for number in range(4)]
    return [*lines, f"Tr: {_line(invert_pose(in_lidar)[:3])}"]


def _line(matrix: np.ndarray) -> str:
    return " ".join(f"{value:.12e}" for value in matrix.ravel())


def _write(path: Path, lines: list[str]) -> None:
    write_text(path, "".join(f"{line}\n" for line in lines))
