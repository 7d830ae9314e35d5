"""A drive as KITTI raw has it, written without the reader's formulas: the inverse of Mercator, R and T."""

from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from nvsf_core.drives.kitti360.scans import write_scan
from nvsf_core.drives.kitti360.writer import write_image
from nvsf_core.geometry.se3 import invert_pose
from nvsf_core.stages.exports.records import DataSet

SEQUENCE = "2011_09_26_drive_0999_sync"
_RADIUS_M = 6378137.0
_LATITUDE = 49.0
_VELO_TO_CAMERA = np.array(
    [[0.0, -1.0, 0.0, 0.02], [0.0, 0.0, -1.0, -0.06], [1.0, 0.0, 0.0, -0.3], [0, 0, 0, 1.0]]
)
_IMU_TO_VELO = np.eye(4)
_IMU_TO_VELO[:3, 3] = -0.8, 0.3, -0.8


def write_raw(root: Path, data: DataSet) -> str:
    """Write the date's folder; returns the sequence. `image_00` of the data becomes `image_02`."""
    place = root / SEQUENCE
    (camera,) = data.cameras.values()
    # P_rect_02 = K [R | t] of the rectified camera 0: a camera of any pose is one.
    rectified = np.eye(4)
    from_first = invert_pose(camera.in_lidar) @ invert_pose(rectified @ _VELO_TO_CAMERA)
    projection = camera.model.matrix @ from_first[:3]
    size = f"{camera.model.width} {camera.model.height}"
    lines = [
        "calib_time: 09-Jan-2012 13:57:47", f"R_rect_00: {_words(rectified[:3, :3])}",
        f"S_rect_02: {size}", f"P_rect_02: {_words(projection)}",
    ]  # fmt: skip
    _write(root / "calib_cam_to_cam.txt", lines)
    for name, pose in (("calib_velo_to_cam", _VELO_TO_CAMERA), ("calib_imu_to_velo", _IMU_TO_VELO)):
        _write(root / f"{name}.txt", [f"R: {_words(pose[:3, :3])}", f"T: {_words(pose[:3, 3])}"])
    stamps = [
        str(datetime(2011, 9, 26, 13, 2, 25) + timedelta(seconds=float(one))) + ".000000"
        for one in data.stamp_s
    ]
    stamps = [one if one.count(".") == 1 else one.rsplit(".", 1)[0] + "000" for one in stamps]
    for folder in ("oxts", "velodyne_points", "image_02"):
        _write(place / folder / "timestamps.txt", stamps)
    # Near the equator of its own scale: the drive's world is moved to a latitude of its own.
    scale = np.cos(np.radians(_LATITUDE))
    for index in range(len(data.numbers)):
        imu = data.lidar_to_world[index] @ _IMU_TO_VELO
        moved_m = imu[:3, 3] - data.lidar_to_world[0, :3, 3] + [0.0, 0.0, 100.0]
        longitude = np.degrees(moved_m[0] / (scale * _RADIUS_M)) + 8.0
        base = np.log(np.tan(np.pi / 4 + np.radians(_LATITUDE) / 2))
        latitude = np.degrees(2.0 * np.arctan(np.exp(base + moved_m[1] / (scale * _RADIUS_M))) - np.pi / 2)
        yaw, pitch, roll = Rotation.from_matrix(imu[:3, :3]).as_euler("ZYX")
        packet = [latitude, longitude, moved_m[2], roll, pitch, yaw, *[0.0] * 24]
        _write(place / "oxts/data" / f"{index:010d}.txt", [" ".join(f"{one:.15g}" for one in packet)])
        scan = data.scan(index)
        write_scan(place / "velodyne_points/data" / f"{index:010d}.bin", scan.rows[:, :3], scan.rows[:, 3])
        write_image(place / "image_02/data" / f"{index:010d}.png", data.image("image_00", index).rgb)
    poses = "".join(
        f"<item><tx>{12.0 + 2.0 * k}</tx><ty>3.0</ty><tz>-1.65</tz><rx>0</rx><ry>0</ry><rz>0.1</rz></item>"
        for k in range(len(data.numbers))
    )
    (place / "tracklet_labels.xml").write_text(
        "<boost_serialization><tracklets><count>1</count><item><objectType>Car</objectType><h>1.5</h>"
        f"<w>1.8</w><l>4.3</l><first_frame>0</first_frame><poses><count>4</count>{poses}</poses></item>"
        "</tracklets></boost_serialization>"
    )
    return SEQUENCE


def _words(matrix: np.ndarray) -> str:
    return " ".join(f"{value:.12e}" for value in matrix.ravel())


def _write(path: Path, lines: list[str]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")
