"""What KITTI's two layouts have in common: numbered `.bin` scans and rectified images of four cameras.

KITTI's images are PNG; copies of it that were made smaller have JPEG in their place.
"""

from abc import abstractmethod
from collections.abc import Mapping
from functools import cached_property
from os.path import lexists
from pathlib import Path

import numpy as np
from scipy.linalg import rq

from nvsf_core.drives.drive import Recorded
from nvsf_core.drives.kitti360.calibration import CameraCalibration
from nvsf_core.drives.kitti360.images import decode_picture, jpeg_size, read_image_bytes
from nvsf_core.drives.kitti360.layout import CAMERAS
from nvsf_core.drives.kitti360.scans import Scan, parse_scan, read_columns, read_scan_bytes
from nvsf_core.drives.plain.layout import IMAGE_KINDS, numbered_files
from nvsf_core.drives.posed import AbstractPosedDrive
from nvsf_core.drives.section import Section
from nvsf_core.drives.unread import require_one_of_each, unnamed_files
from nvsf_core.errors import CalibrationError
from nvsf_core.geometry.pinhole import Pinhole, intrinsics_fault
from nvsf_core.geometry.se3 import invert_pose
from nvsf_core.sensors.tables import HDL_64E

_MOST_HEADER_BYTES = 1 << 20
"""Before a JPEG's size there may be a preview and a colour profile."""
CAMERA_AXES_TO_Z_UP = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""From a camera's axes (x right, y down, z forward) to x forward, y left, z up."""


class AbstractKittiDrive(AbstractPosedDrive):
    """KITTI's scans and images; the layouts differ in folders, calibration, poses and times."""

    @property
    @abstractmethod
    def scans_dir(self) -> Path:
        """Folder of the scans."""

    @abstractmethod
    def images_dir(self, camera: str) -> Path:
        """Folder of a camera's images."""

    @property
    def column_dirs(self) -> Mapping[str, Path]:
        """Folders of what is known of each point beside the scans, by names of `COLUMNS`; KITTI has none."""
        return {}

    @property
    @abstractmethod
    def tables(self) -> tuple[Path, ...]:
        """Files of calibration, poses and times, whether they exist or not; the first ones are needed."""

    @property
    @abstractmethod
    def needed(self) -> tuple[Path, ...]:
        """Files without which nothing can be read."""

    def frame_files(self, frame: int) -> tuple[Path, ...]:
        """Files of one frame beside its scan and images."""
        return ()

    @cached_property
    def scan_files(self) -> dict[int, Path]:
        """The drive's scans by frame."""
        return numbered_files(self.scans_dir, ("bin",))

    @cached_property
    def column_files(self) -> dict[str, dict[int, Path]]:
        """Files beside the scans, by what they hold and frame."""
        return {name: numbered_files(folder, ("bin",)) for name, folder in self.column_dirs.items()}

    @cached_property
    def image_files(self) -> dict[str, dict[int, Path]]:
        """The drive's images by camera and frame."""
        found = {name: _image_files(self.images_dir(name)) for name in CAMERAS}
        return {name: files for name, files in found.items() if files}

    @property
    def wanted_cameras(self) -> tuple[str, ...]:
        """Cameras of the scene.

        Raises:
            CalibrationError: One was asked for and has no images.
        """
        for name in self.scene.cameras or ():
            if name not in self.image_files:
                raise CalibrationError(
                    f"camera {name} was asked for, but has no images in {self.images_dir(name)}; take it out "
                    "of `cameras` in the catalogue, or put them there"
                )
        return tuple(self.image_files) if self.scene.cameras is None else self.scene.cameras

    def has_data(self) -> bool:
        """Whether a scan or an image of the section is there."""
        found = [self.scan_files, *self.image_files.values()]
        return any(frame in files for files in found for frame in self.frames)

    def section(self) -> Section:
        """Calibration, poses, times, and the section's scans and images."""
        used = [
            files for name, files in self.image_files.items()
            if self.scene.cameras is None or name in self.scene.cameras
        ]  # fmt: skip
        frames = [
            path for frame in self.frames
            for path in (
                *(
                    files[frame] for files in (self.scan_files, *self.column_files.values(), *used)
                    if frame in files
                ),
                *self.frame_files(frame),
            )
        ]  # fmt: skip
        folders = [self.scans_dir, *(self.images_dir(name) for name in CAMERAS)]
        everything = sorted(self.scan_files or {k for files in self.image_files.values() for k in files})
        gaps = [frame for frame in self.frames if self.scan_files and frame not in self.scan_files]
        return Section(
            files=tuple(path for path in (*self.tables, *frames) if lexists(path)),
            folders=tuple(folder for folder in folders if folder.is_dir()),
            missing=tuple(
                path.relative_to(self.scene.root).as_posix() for path in self.needed if not lexists(path)
            ),
            gaps=tuple(f"{self.scans_dir.relative_to(self.scene.root)}/{frame}.bin" for frame in gaps),
            recorded=(everything[0], everything[-1]) if everything else None,
        )

    def unread(self) -> list[str]:
        """Misnamed files. A JPEG beside a frame's PNG is none."""
        used = CAMERAS if self.scene.cameras is None else self.scene.cameras
        folders = [self.images_dir(name) for name in used]
        words = []
        for folder in (self.scans_dir, *self.column_dirs.values()):
            words += unnamed_files(folder, ("bin",))
            require_one_of_each(folder, ("bin",), self.frames)
        words += [one for folder in folders for one in unnamed_files(folder, IMAGE_KINDS)]
        for folder in folders:
            require_one_of_each(folder, ("png",), self.frames)
            require_one_of_each(folder, ("jpg", "jpeg"), self.frames)
        return words

    def has_scans(self) -> bool:
        """Whether there is a scan at all."""
        return bool(self.scan_files)

    def recorded_sensor(self) -> str:
        """KITTI's LiDAR."""
        return HDL_64E.name

    def camera_place(self, camera: str) -> Path | None:
        """Its folder of images."""
        return self.images_dir(camera) if camera in self.image_files else None

    def find_scan(self, frame: int) -> Recorded | None:
        """The bytes of a `.bin`, and of what lies beside it."""
        path = self.scan_files.get(frame)
        if path is None:
            return None
        beside = {name: files[frame] for name, files in self.column_files.items() if frame in files}
        return Recorded(path, read_scan_bytes(path), read_columns(beside))

    def _decoded(self, found: Recorded) -> Scan:
        """Float32 x, y, z, reflectance."""
        return parse_scan(found.path, found.data, found.beside)

    def find_image(self, camera: str, frame: int, width: int, height: int) -> Recorded | None:
        """The bytes of a PNG or JPEG."""
        path = self.image_files.get(camera, {}).get(frame)
        return None if path is None else Recorded(path, read_image_bytes(path, width, height))

    def parse_image(self, camera: str, found: Recorded, width: int, height: int) -> np.ndarray:
        """Decode a PNG or JPEG."""
        return decode_picture(found.path, found.data, width, height)


def camera_of_projection(
    name: str, projection: np.ndarray, size_px: tuple[int, int], first_to_pose: np.ndarray, where: str
) -> CameraCalibration:
    """A rectified camera from its projection K [R | t] of the first rectified camera's frame.

    Args:
        name: The camera.
        projection: (3, 4).
        size_px: Columns and rows of its images.
        first_to_pose: (4, 4) first rectified camera to pose frame.
        where: File and key, for messages.

    Raises:
        CalibrationError: It is no projection of a camera.
    """
    if not np.isfinite(projection).all() or abs(np.linalg.det(projection[:, :3])) < 1e-9:
        raise CalibrationError(f"{where}: expected a projection of a camera, found {projection.tolist()}")
    matrix, turn = rq(projection[:, :3])
    # Focal lengths are positive: signs belong to the rotation.
    signs = np.diag(np.sign(np.diag(matrix)))
    matrix, turn = matrix @ signs, signs @ turn
    scale = matrix[2, 2]
    from_first = np.eye(4)
    from_first[:3, :3] = turn
    from_first[:3, 3] = np.linalg.solve(matrix, projection[:, 3])
    fx, fy, cx, cy = (float(matrix[at] / scale) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    fault = intrinsics_fault((fx, fy), (cx, cy), size_px)
    if fault is not None or np.linalg.det(turn) < 0 or abs(matrix[0, 1]) > 1e-3 * abs(matrix[0, 0]):
        raise CalibrationError(f"{where}: {fault or 'expected a projection without mirror and skew'}")
    return CameraCalibration(
        name=name,
        intrinsics=Pinhole(fx, fy, cx, cy, *size_px),
        to_pose=first_to_pose @ invert_pose(from_first),
    )


def _image_files(folder: Path) -> dict[int, Path]:
    """Images by frame; where there are both, the original, a PNG."""
    return dict(
        sorted({**numbered_files(folder, ("jpg", "jpeg")), **numbered_files(folder, ("png",))}.items())
    )


def image_size(path: Path) -> tuple[int, int]:
    """Columns and rows that the header of a PNG or JPEG claims.

    Raises:
        CalibrationError: It is neither.
    """
    with path.open("rb") as file:
        head = file.read(_MOST_HEADER_BYTES)
    if len(head) >= 24 and head.startswith(b"\x89PNG"):
        return int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")
    found = jpeg_size(head) if head.startswith(b"\xff\xd8") else None
    if found is None:
        raise CalibrationError(
            f"{path}: expected a PNG or JPEG whose size says the camera's, found none; copy it again"
        )
    return found
