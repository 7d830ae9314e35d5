"""What the flow reads of a recorded drive, whatever its format, and which class reads a scene's.

Frames: a pose is the pose frame's in the world. The LiDAR has x forward, y left, z up; a camera x right,
y down, z forward. A frame's time is the instant of its pose.
"""

import importlib
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nvsf_core.drives.entries import KITTI360, SceneEntry
from nvsf_core.drives.kitti360.boxes import Box
from nvsf_core.drives.kitti360.calibration import Calibration
from nvsf_core.drives.kitti360.frames import FrameTimes, PoseDisagreement
from nvsf_core.drives.kitti360.scans import Scan
from nvsf_core.drives.kitti360.text import checksum_of
from nvsf_core.drives.section import Section
from nvsf_core.errors import DataError

__all__ = ["AbstractDrive", "Boxes", "DriveFacts", "Recorded", "drive_of", "has_data", "why_no_data"]

_READERS = {
    "kitti360": "nvsf_core.drives.kitti360.source:Kitti360Drive",
    "plain": "nvsf_core.drives.plain.source:PlainDrive",
    "kitti_odometry": "nvsf_core.drives.kitti.odometry:KittiOdometryDrive",
    "kitti_raw": "nvsf_core.drives.kitti.raw:KittiRawDrive",
    "bag": "nvsf_core.drives.bags.source:BagDrive",
}
"""The class of each `kind` of scene, one folder a format. Imported when a drive is read: images are decoded
by a library that takes long to load."""

_OWN_FOLDERS = {
    "kitti360": ("calibration", "data_2d_raw", "data_3d_raw", "data_3d_bboxes", "data_poses"),
    "plain": ("scans", "images", "ring", "time"),
    "kitti_odometry": ("sequences", "poses"),
    "kitti_raw": ("",),
    "bag": ("",),
}
"""Folders of a drive's root, by its kind, in which no outputs may lie; the root itself where it is empty."""


@dataclass(frozen=True, slots=True)
class Recorded:
    """The bytes of one scan or image, as they are recorded."""

    path: Path
    """The file, for messages; in a bag the bag's, with topic and time."""
    data: bytes
    beside: tuple[tuple[str, bytes], ...] = ()
    """Files beside a scan that hold more of its points, as `ring` and `time`."""

    @property
    def checksum(self) -> str:
        """`checksum_of` all of it."""
        return checksum_of(b"".join([self.data, *(data for _, data in self.beside)]))


@dataclass(frozen=True, slots=True)
class Boxes:
    """Labelled boxes of a section."""

    boxes: tuple[Box, ...] = ()
    left_out: tuple[str, ...] = ()
    """Boxes that were left out, and why."""
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveFacts:
    """What a section's calibration, poses and times say, before a scan or an image is opened."""

    calibration: Calibration
    poses: dict[int, np.ndarray]
    """Frame number to (4, 4) float64, pose frame to world; a frame without a pose is absent."""
    poses_place: Path
    """Where the poses stand, for messages."""
    times: FrameTimes
    """Of the section's frames, first to last."""
    has_scans: bool
    """Whether the drive has a LiDAR."""
    sensor: str
    """Name of the LiDAR's table; empty = its lasers are to be found from the scans."""
    boxes_after_s: float = 0.0
    """Seconds from a frame's instant to the moment that its labelled boxes are of."""
    disagreement: PoseDisagreement | None = None
    """Of two sources of the same poses; None if there is one."""
    notes: tuple[str, ...] = ()
    """What was assumed or left out, and why."""


class AbstractDrive(ABC):
    """A section of a recorded drive."""

    def __init__(self, scene: SceneEntry) -> None:
        self.scene = scene

    @property
    def frames(self) -> range:
        """Frame numbers of the section."""
        return range(self.scene.first_frame, self.scene.last_frame + 1)

    @abstractmethod
    def has_data(self) -> bool:
        """Whether a scan or an image of the section is on this machine.

        Raises:
            OSError: A folder cannot be read.
            DataError: What lies there is not of this format.
        """

    @abstractmethod
    def section(self) -> Section:
        """Which files the section reads, and whether they are all there; none of its scans is opened.

        Raises:
            OSError: A folder cannot be read.
        """

    @abstractmethod
    def facts(self) -> DriveFacts:
        """Calibration, poses and times of the section.

        Raises:
            CalibrationError: A calibration file is absent, or a key is missing or damaged.
            DataError: A line of poses or times cannot be read.
        """

    def unread(self) -> list[str]:
        """Words on what seems to be the drive's and is not read, as misnamed files; by default nothing.

        Raises:
            DataError: A sensor would be lost by it, or a frame has two files.
            OSError: A folder cannot be read.
        """
        return []

    @abstractmethod
    def times(self) -> FrameTimes:
        """Times of the section's frames.

        Raises:
            DataError: They cannot be read.
        """

    @abstractmethod
    def places_m(self) -> np.ndarray:
        """(n, 3) positions of the drive's poses in the world, metres; n = 0 where there is none yet.

        Raises:
            DataError: The poses cannot be read.
        """

    @abstractmethod
    def camera_place(self, camera: str) -> Path | None:
        """Where a camera's images lie; None if the drive has no such camera."""

    @abstractmethod
    def find_scan(self, frame: int) -> Recorded | None:
        """The recorded bytes of a frame's scan, not validated; None if there is none.

        Raises:
            DataError: They cannot be read, or are too large for a scan.
        """

    @abstractmethod
    def parse_scan(self, found: Recorded) -> Scan:
        """Validate and decode a scan.

        Raises:
            DataError: It is damaged, or too much of it is absurd.
        """

    @abstractmethod
    def find_image(self, camera: str, frame: int, width: int, height: int) -> Recorded | None:
        """The recorded bytes of a camera's image, not validated; None if there is none.

        Raises:
            DataError: They cannot be read, or are too large for an image of that size.
        """

    @abstractmethod
    def parse_image(self, camera: str, found: Recorded, width: int, height: int) -> np.ndarray:
        """Validate and decode an image: (height, width, 3) uint8 RGB, as the calibration describes it.

        Raises:
            DataError: It is damaged, or of another size.
        """

    def rectified(self, camera: str, rgb: np.ndarray) -> np.ndarray:
        """An image (h, w, 3) as its calibration describes it; by default it is recorded so.

        `parse_image` has done this already.
        """
        return rgb

    def other_scans(self) -> str:
        """Which recorded scans are not read, and how they would be, for messages; empty = none."""
        return ""

    def scan_name(self, frame: int) -> str:
        """What a frame's scan would be called, for messages."""
        return f"{frame:010d}.bin"

    def image_name(self, camera: str, frame: int) -> str:
        """What a camera's image would be called, for messages."""
        return f"{frame:010d}.png"

    def why_no_pose(self, frame: int, place: str) -> str:
        """Why a frame has no pose in the file of that name, for messages."""
        return f"no pose in {place}"

    def pose_at_image(self, camera: str, frame: int, pose: np.ndarray) -> np.ndarray:
        """(4, 4) pose frame to world when a camera's image was taken; by default the frame's own pose."""
        return pose

    def image_delay_s(self, camera: str, frame: int) -> float | None:
        """Seconds from a frame's instant to an image of it; None = images have no times of their own."""
        return None

    def boxes(self) -> Boxes:
        """Labelled boxes of the section; by default there are none.

        Raises:
            DataError: Their file cannot be read.
        """
        return Boxes()

    def read_scan(self, frame: int, checksum: str = "") -> Scan:
        """A frame's usable returns; `checksum` is `Recorded`'s when it was validated, empty = not compared.

        Raises:
            DataError: It is absent, damaged, or has changed since.
        """
        found = self.find_scan(frame)
        if found is None:
            raise DataError(
                f"no scan file {self.scan_name(frame)} of {self.scene.root}; unpack the drive's scans"
            )
        _require_unchanged(found, checksum)
        return self.parse_scan(found)

    def read_image(self, camera: str, frame: int, width: int, height: int, checksum: str = "") -> np.ndarray:
        """A camera's image, (height, width, 3) uint8 RGB.

        Args:
            camera: Its name.
            frame: Frame number.
            width: Expected columns, pixels.
            height: Expected rows, pixels.
            checksum: The `Recorded.checksum` when it was validated; empty = not compared.

        Raises:
            DataError: It is absent, damaged, of another size, or has changed since.
        """
        found = self.find_image(camera, frame, width, height)
        if found is None:
            raise DataError(
                f"no image file {self.image_name(camera, frame)} of {self.scene.root}; unpack its images"
            )
        _require_unchanged(found, checksum)
        return self.parse_image(camera, found, width, height)


def drive_of(scene: SceneEntry) -> AbstractDrive:
    """The reader of a scene's drive; nothing is opened yet."""
    module, _, name = _READERS[scene.kind].partition(":")
    reader: type[AbstractDrive] = getattr(importlib.import_module(module), name)
    return reader(scene)


def has_data(scene: SceneEntry) -> bool:
    """Whether a scan or an image of the scene is on this machine.

    Raises:
        DataError: The folders cannot be read.
    """
    try:
        return drive_of(scene).has_data()
    except OSError as error:
        raise DataError(
            f"scene {scene.name}: cannot look into {error.filename or scene.root} ({error.strerror}); "
            "correct its root, or its permissions"
        ) from error


def own_folders(scene: SceneEntry) -> list[Path]:
    """Folders of a scene's drive in which nothing may be written; the root itself where it is one drive's."""
    return [scene.root / name for name in _OWN_FOLDERS[scene.kind]]


def require_outside(place: Path, folders: Sequence[Path]) -> None:
    """Refuse a folder to make that would lie in a recorded drive's.

    Raises:
        DataError: It lies in one of them, or is one.
    """
    for own in folders:
        if place.resolve().is_relative_to(own.resolve()):
            raise DataError(
                f"{place}: expected a folder outside of the drive, found it in {own}; name another"
            )


def why_no_data(scene: SceneEntry) -> str:
    """Why nothing of a scene's frames is on this machine, and what to do.

    Raises:
        DataError: There are files, under names that are not read.
        OSError: A folder cannot be read.
    """
    source = drive_of(scene)
    source.unread()
    recorded = source.section().recorded
    frames = f"frames {scene.first_frame} to {scene.last_frame}"
    asked = f"expected scans or images of {frames} of {scene.sequence} under {scene.root}"
    if recorded is not None:
        return (
            f"{asked}, found frames within {recorded[0]} to {recorded[1]}; correct first_frame and last_frame"
        )
    words = "correct its root, or set NVSF_KITTI360_ROOT" if scene.kind == KITTI360 else "correct its root"
    return f"{asked}, found none; {words}"


def _require_unchanged(found: Recorded, validated: str) -> None:
    if validated and found.checksum != validated:
        raise DataError(
            f"{found.path}: changed since the stage `frames` validated it (expected SHA-256 {validated}..., "
            f"found {found.checksum}...); run again, and where that does not help delete the scene's output "
            "`frames` first"
        )
