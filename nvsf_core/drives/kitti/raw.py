"""A drive of KITTI raw: `2011_09_26/2011_09_26_drive_0005_sync`, with oxts poses and tracklets."""

from functools import cached_property
from os.path import lexists
from pathlib import Path

import numpy as np

from nvsf_core.drives.drive import Boxes
from nvsf_core.drives.kitti.files import AbstractKittiDrive, camera_of_projection
from nvsf_core.drives.kitti.poses import oxts_poses, read_oxts
from nvsf_core.drives.kitti.tracklets import read_tracklets
from nvsf_core.drives.kitti360.calibration import Calibration
from nvsf_core.drives.kitti360.frames import read_timestamps, seconds_since_1970
from nvsf_core.drives.kitti360.text import KeyedText, rigid, rotation
from nvsf_core.drives.plain.layout import numbered_files
from nvsf_core.drives.posed import PosePath, require_ascending
from nvsf_core.errors import CalibrationError, DataError
from nvsf_core.geometry.se3 import invert_pose

_LONGEST_ARM_M = 100.0


class KittiRawDrive(AbstractKittiDrive):
    """Reads synchronised, rectified drives. The root is the date's folder; the pose frame is the IMU's."""

    @property
    def _place(self) -> Path:
        return self.scene.root / self.scene.sequence

    @property
    def scans_dir(self) -> Path:
        """`velodyne_points/data`."""
        return self._place / "velodyne_points" / "data"

    def images_dir(self, camera: str) -> Path:
        """`image_00/data`."""
        return self._place / camera / "data"

    @property
    def _oxts_dir(self) -> Path:
        return self._place / "oxts" / "data"

    @property
    def tracklets_path(self) -> Path:
        """Labelled boxes, or where they would lie."""
        return self._place / "tracklet_labels.xml"

    @property
    def needed(self) -> tuple[Path, ...]:
        """Calibration and times."""
        names = ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt", "calib_imu_to_velo.txt")
        return (*(self.scene.root / name for name in names), self._stamps_file("velodyne_points"))

    @property
    def tables(self) -> tuple[Path, ...]:
        """Calibration, times and tracklets."""
        folders = ("oxts", "image_00", "image_01", "image_02", "image_03")
        return (*self.needed, *map(self._stamps_file, folders), self.tracklets_path)

    def frame_files(self, frame: int) -> tuple[Path, ...]:
        """The packets around the frame: the path is interpolated between them."""
        near = range(max(0, frame - 2), frame + 3)
        return tuple(self._oxts_dir / f"{number:010d}.txt" for number in near)

    def _stamps_file(self, folder: str) -> Path:
        return self._place / folder / "timestamps.txt"

    @property
    def times_source(self) -> str:
        """For messages."""
        return "velodyne_points/timestamps.txt"

    @cached_property
    def _begin(self) -> np.datetime64:
        stamps = read_timestamps(self._stamps_file("velodyne_points"))
        known = stamps[~np.isnat(stamps)]
        if len(known) == 0:
            raise DataError(f"{self._stamps_file('velodyne_points')}: expected times, found none")
        return known[0]

    def _seconds_of(self, folder: str) -> dict[int, float]:
        """Seconds since the first scan's stamp, by the number of the line."""
        path = self._stamps_file(folder)
        if not lexists(path):
            return {}
        seconds = (read_timestamps(path) - self._begin) / np.timedelta64(1, "s")
        return {k: float(one) for k, one in enumerate(seconds) if np.isfinite(one)}

    def frame_seconds(self) -> dict[int, float]:
        """Stamps of the scans: the laser faces forward."""
        found = self._seconds_of("velodyne_points")
        stamps_file, numbers = str(self._stamps_file("velodyne_points")), list(found)
        require_ascending(np.array(list(found.values())), stamps_file, lambda row: numbers[row] + 1)
        return found

    def clock_zero_s(self) -> float:
        """The first scan's stamp."""
        return seconds_since_1970(self._begin)

    @cached_property
    def _image_seconds(self) -> dict[str, dict[int, float]]:
        return {name: self._seconds_of(name) for name in self.image_files}

    def image_seconds(self, camera: str) -> dict[int, float]:
        """Stamps of a camera's images."""
        return self._image_seconds.get(camera, {})

    def pose_path(self) -> PosePath | None:
        """Poses of the packets; a packet that cannot be read is left out."""
        stamps = self._seconds_of("oxts")
        found, numbers = [], []
        for number, path in numbered_files(self._oxts_dir, ("txt",)).items():
            if number not in stamps:
                continue
            try:
                found.append(read_oxts(path))
            except DataError:
                continue  # its frame's pose is interpolated between its neighbours' packets
            numbers.append(number)
        if not found:
            return None
        time_s = np.array([stamps[number] for number in numbers])
        require_ascending(time_s, str(self._stamps_file("oxts")), lambda row: numbers[row] + 1)
        return PosePath(time_s, oxts_poses(np.array(found)), self._oxts_dir)

    def calibration(self) -> Calibration:
        """The date's three calibration files."""
        root = self.scene.root
        imu_to_velo = _mounting(root / "calib_imu_to_velo.txt")
        velo_to_camera = _mounting(root / "calib_velo_to_cam.txt")
        lidar_to_pose = invert_pose(imu_to_velo)
        cameras = {}
        if self.wanted_cameras:
            path = root / "calib_cam_to_cam.txt"
            table = KeyedText.read(path)
            rectified = np.eye(4)
            rectified[:3, :3] = table.matrix("R_rect_00", (3, 3), rotation)
            first_to_pose = lidar_to_pose @ invert_pose(rectified @ velo_to_camera)
            for name in self.wanted_cameras:
                number = name[-2:]
                width, height = table.matrix(f"S_rect_{number}", (2,)).tolist()
                key = f"P_rect_{number}"
                cameras[name] = camera_of_projection(
                    name,
                    table.matrix(key, (3, 4)),
                    (int(width), int(height)),
                    first_to_pose,
                    f"{path}, {key}",
                )
        return Calibration(lidar_to_pose=lidar_to_pose, lidar_is_assumed=False, cameras=cameras, notes=())

    def boxes(self) -> Boxes:
        """Tracklets, placed by the poses of their frames."""
        if not lexists(self.tracklets_path):
            return Boxes()
        facts = self.facts()
        lidar_to_world = {
            frame: pose @ facts.calibration.lidar_to_pose for frame, pose in facts.poses.items()
        }
        boxes, left_out = read_tracklets(self.tracklets_path, lidar_to_world)
        return Boxes(tuple(boxes), tuple(left_out))


def _mounting(path: Path) -> np.ndarray:
    """(4, 4) of a file with `R` and `T`."""
    table = KeyedText.read(path)
    values = np.column_stack([table.matrix("R", (3, 3)), table.matrix("T", (3,))])
    try:
        return rigid(values.reshape(-1), _LONGEST_ARM_M)
    except ValueError as error:
        raise CalibrationError(f"{path}: {error}; restore the file of the drive") from error
