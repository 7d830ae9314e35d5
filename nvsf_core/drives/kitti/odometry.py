"""A sequence of KITTI's odometry benchmark: `sequences/00`, `poses/00.txt`."""

from os.path import lexists
from pathlib import Path

import numpy as np

from nvsf_core.drives.drive import DriveFacts
from nvsf_core.drives.kitti.files import (
    CAMERA_AXES_TO_Z_UP,
    AbstractKittiDrive,
    camera_of_projection,
    image_size,
)
from nvsf_core.drives.kitti.poses import read_poses, read_seconds
from nvsf_core.drives.kitti360.calibration import Calibration
from nvsf_core.drives.kitti360.scans import COLUMNS
from nvsf_core.drives.kitti360.text import KeyedText
from nvsf_core.drives.posed import PosePath, require_ascending
from nvsf_core.drives.unread import require_files_of_scans
from nvsf_core.errors import CalibrationError, DataError

_NUMBERS = {f"image_0{number}": number for number in range(4)}


class KittiOdometryDrive(AbstractKittiDrive):
    """Reads `velodyne`, `image_0` to `image_3` (as `image_00` to `image_03`), `calib.txt`, `times.txt`.

    The pose frame is the first rectified camera's. The world has its axes turned to x forward, y left, z up.
    """

    @property
    def _place(self) -> Path:
        return self.scene.root / "sequences" / self.scene.sequence

    @property
    def poses_file(self) -> Path:
        """Poses of the first camera, a line a frame: the benchmark's, else SemanticKITTI's own ones."""
        places = (self.scene.root / "poses" / f"{self.scene.sequence}.txt", self._place / "poses.txt")
        return next((path for path in places if lexists(path)), places[0])

    @property
    def scans_dir(self) -> Path:
        """`velodyne`."""
        return self._place / "velodyne"

    @property
    def column_dirs(self) -> dict[str, Path]:
        """`velodyne_ring` and `velodyne_time`, which only trees that this project wrote have."""
        return {name: self._place / f"velodyne_{name}" for name in COLUMNS}

    def images_dir(self, camera: str) -> Path:
        """`image_0` to `image_3`."""
        return self._place / f"image_{_NUMBERS.get(camera, camera)}"

    @property
    def needed(self) -> tuple[Path, ...]:
        """Calibration and times."""
        return self._place / "calib.txt", self._place / "times.txt"

    @property
    def tables(self) -> tuple[Path, ...]:
        """Calibration, times and poses."""
        return (*self.needed, self.poses_file)

    @property
    def times_source(self) -> str:
        """For messages."""
        return "times.txt"

    def frame_seconds(self) -> dict[int, float]:
        """`times.txt`: a line a frame from frame 0."""
        path = self._place / "times.txt"
        seconds = read_seconds(path)
        require_ascending(seconds, str(path), lambda row: row + 1)
        return dict(enumerate(seconds.tolist()))

    def pose_path(self) -> PosePath | None:
        """Poses of the benchmark's training sequences, or SemanticKITTI's; else None, as of 11 to 21."""
        if not lexists(self.poses_file):
            return None
        poses, seconds = read_poses(self.poses_file), read_seconds(self._place / "times.txt")
        if len(poses) != len(seconds):
            raise DataError(
                f"{self.poses_file}: expected {len(seconds)} poses as times.txt has, found {len(poses)}"
            )
        return PosePath(seconds, CAMERA_AXES_TO_Z_UP @ poses, self.poses_file)

    def facts(self) -> DriveFacts:
        """Calibration, poses and times.

        Raises:
            DataError: There are rings or times, and none of any scan; and see the base class.
        """
        for folder in self.column_dirs.values():
            require_files_of_scans(folder, self.scan_files)
        return super().facts()

    def calibration(self) -> Calibration:
        """`calib.txt`: `Tr` of the LiDAR, `P0` to `P3` of the cameras."""
        path = self._place / "calib.txt"
        table = KeyedText.read(path)
        key = "Tr" if "Tr" in table.lines else "Tr_velo_to_cam"
        cameras = {}
        for name in self.wanted_cameras:
            own = f"P{_NUMBERS[name]}"
            size_px = image_size(next(iter(self.image_files[name].values())))
            projection = table.matrix(own, (3, 4))
            cameras[name] = camera_of_projection(name, projection, size_px, np.eye(4), f"{path}, {own}")
        if key not in table.lines and self.has_scans():
            raise CalibrationError(
                f"{path}: expected `Tr`, the LiDAR's mounting, found none; restore the file"
            )
        to_pose = table.mounting(key) if key in table.lines else np.eye(4)
        return Calibration(
            lidar_to_pose=to_pose, lidar_is_assumed=key not in table.lines, cameras=cameras, notes=()
        )
