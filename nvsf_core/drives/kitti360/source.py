"""A section of a drive in KITTI-360's layout."""

import contextlib
from collections.abc import Iterator
from dataclasses import replace
from os.path import lexists
from pathlib import Path

import numpy as np

from nvsf_core.drives.drive import AbstractDrive, Boxes, DriveFacts, Recorded
from nvsf_core.drives.entries import SceneEntry
from nvsf_core.drives.kitti360.boxes import read_boxes
from nvsf_core.drives.kitti360.calibration import (
    Calibration,
    read_calibration,
    read_rectified_camera0_to_pose,
)
from nvsf_core.drives.kitti360.frames import (
    FrameTimes,
    PoseDisagreement,
    compare_poses,
    frame_times,
    read_cam0_to_world,
    read_poses,
    recorded_frames,
    sweep_of,
)
from nvsf_core.drives.kitti360.images import decode_image, read_image_bytes
from nvsf_core.drives.kitti360.layout import CAMERAS, FISHEYE_CAMERAS, DriveLayout
from nvsf_core.drives.kitti360.scans import COLUMNS, Scan, parse_scan, read_columns, read_scan_bytes
from nvsf_core.drives.kitti360.text import require_folder
from nvsf_core.drives.section import Section
from nvsf_core.drives.unread import (
    require_files_of_scans,
    require_none_in,
    unnamed_files,
    with_folders_below,
)
from nvsf_core.errors import DataError
from nvsf_core.sensors.sweep import sweep_by_points_s
from nvsf_core.sensors.tables import HDL_64E


class Kitti360Drive(AbstractDrive):
    """Reads KITTI-360: `.bin` scans, PNG images, `poses.txt`, keyed calibration, XML boxes."""

    def __init__(self, scene: SceneEntry) -> None:
        super().__init__(scene)
        self._layout = DriveLayout(scene.root, scene.sequence)

    def has_data(self) -> bool:
        """Whether a scan or an image is there."""
        return any(
            self._layout.scan_path(frame).is_file()
            or any(self._layout.image_path(name, frame).is_file() for name in CAMERAS)
            for frame in self.frames
        )

    def section(self) -> Section:
        """The files that the section reads."""
        scene, layout = self.scene, self._layout
        used = scene.cameras if scene.cameras is not None else CAMERAS
        places = [layout.scan_path(0).parent, *(layout.camera_dir(name) for name in CAMERAS)]
        folders = tuple(place for place in places if place.is_dir())
        wanted = [
            path for frame in self.frames
            for path in (layout.scan_path(frame), *(layout.image_path(camera, frame) for camera in used))
            if path.parent in folders
        ]  # fmt: skip
        beside = [layout.column_path(name, frame) for name in COLUMNS for frame in self.frames]
        frames = recorded_frames(layout)
        needed = [layout.poses_path, layout.calibration_dir]
        return Section(
            files=tuple(path for path in (*_common_files(layout), *wanted, *beside) if lexists(path)),
            folders=folders,
            missing=tuple(_below(path, layout) for path in needed if not lexists(path)),
            gaps=tuple(_below(path, layout) for path in wanted if not lexists(path)),
            recorded=(frames[0], frames[-1]) if frames else None,
        )

    def unread(self) -> list[str]:
        """Misnamed files, and scans in a folder of another name."""
        layout = self._layout
        scans, sequence = layout.scan_path(0).parent, layout.velodyne_dir.parent
        if not scans.is_dir() and sequence.is_dir():
            require_none_in(with_folders_below([sequence, *sequence.iterdir()]), scans, ("bin",))
        used = self.scene.cameras if self.scene.cameras is not None else CAMERAS
        words = unnamed_files(scans, ("bin",))
        words += [one for name in COLUMNS for one in unnamed_files(layout.column_dir(name), ("bin",))]
        return words + [one for name in used for one in unnamed_files(layout.camera_dir(name), ("png",))]

    def times(self) -> FrameTimes:
        """Times of the frames, from the timestamp files or a nominal period; see `SceneEntry`."""
        scene = self.scene
        times = frame_times(self._layout, scene.first_frame, scene.last_frame, scene.sweep_period_s)
        if scene.sweep_period_s is not None:
            return times
        known_s = self._sweep_by_points_s(times.sweep_period_s)
        return replace(times, sweep_period_s=sweep_of(known_s, times.sweep_period_s))

    def _sweep_by_points_s(self, step_s: float) -> float | None:
        """Duration of a sweep by the first scan that has times of its points and can be read."""
        for frame in self.frames:
            if lexists(self._layout.column_path("time", frame)):
                with contextlib.suppress(DataError):  # named where the frame itself is read
                    scan = self.read_scan(frame)
                    return sweep_by_points_s(scan.points, scan.offset_s, step_s)
        return None

    def facts(self) -> DriveFacts:
        """Calibration, poses and times.

        Raises:
            DataError: There are rings or times, and none of any scan; and see the base class.
        """
        layout, recorded = self._layout, recorded_frames(self._layout)
        for name in COLUMNS:
            require_files_of_scans(layout.column_dir(name), recorded)
        has_scans = require_folder(layout.velodyne_dir) and require_folder(layout.scan_path(0).parent)
        calibration = read_calibration(layout, self.scene.cameras, has_scans=has_scans)
        poses = read_poses(layout.poses_path)
        return DriveFacts(
            calibration=calibration, poses=poses, poses_place=layout.poses_path, times=self.times(),
            has_scans=has_scans, sensor=self.scene.lidar or HDL_64E.name,
            disagreement=self._disagreement(poses, calibration),
        )  # fmt: skip

    def places_m(self) -> np.ndarray:
        """Positions of `poses.txt`."""
        if not self._layout.poses_path.is_file():
            return np.zeros((0, 3))
        return np.array([pose[:3, 3] for pose in read_poses(self._layout.poses_path).values()]).reshape(-1, 3)

    def camera_place(self, camera: str) -> Path | None:
        """Its folder of images."""
        place = self._layout.camera_dir(camera)
        return place if place.is_dir() else None

    def find_scan(self, frame: int) -> Recorded | None:
        """The bytes of a `.bin`, and of what lies beside it."""
        path = self._layout.scan_path(frame)
        if not lexists(path):
            return None
        beside = {name: self._layout.column_path(name, frame) for name in COLUMNS}
        there = {name: one for name, one in beside.items() if lexists(one)}
        return Recorded(path, read_scan_bytes(path), read_columns(there))

    def parse_scan(self, found: Recorded) -> Scan:
        """Decode float32 x, y, z, reflectance, and ring and time beside them."""
        return parse_scan(found.path, found.data, found.beside)

    def find_image(self, camera: str, frame: int, width: int, height: int) -> Recorded | None:
        """The bytes of a PNG."""
        path = self._layout.image_path(camera, frame)
        return Recorded(path, read_image_bytes(path, width, height)) if lexists(path) else None

    def parse_image(self, camera: str, found: Recorded, width: int, height: int) -> np.ndarray:
        """Decode a PNG."""
        return decode_image(found.path, found.data, width, height)

    def boxes(self) -> Boxes:
        """Boxes of `data_3d_bboxes`."""
        layout = self._layout
        require_folder(layout.boxes_dir)
        paths = layout.boxes_paths
        if not paths:
            return Boxes()
        # `train_full`, the last by name, has whole objects; `train` cuts them at its windows.
        boxes, left_out = read_boxes(paths[-1], self.scene.first_frame, self.scene.last_frame)
        notes = [f"boxes read from {paths[-1].relative_to(layout.root)}"] if len(paths) > 1 else []
        return Boxes(tuple(boxes), tuple(left_out), tuple(notes))

    def _disagreement(
        self, poses: dict[int, np.ndarray], calibration: Calibration
    ) -> PoseDisagreement | None:
        layout = self._layout
        # First: without that file nothing is compared, and a drive without camera 0 need not describe it.
        if not lexists(layout.cam0_to_world_path):
            return None
        camera0 = calibration.cameras.get("image_00")
        camera0_to_pose = read_rectified_camera0_to_pose(layout) if camera0 is None else camera0.to_pose
        if camera0_to_pose is None:
            return None
        ours = {frame: poses[frame] @ camera0_to_pose for frame in self.frames if frame in poses}
        return compare_poses(ours, read_cam0_to_world(layout.cam0_to_world_path))


def _common_files(layout: DriveLayout) -> Iterator[Path]:
    """Files that are read whatever frames a scene has."""
    yield from (layout.perspective_path, layout.cam_to_pose_path, layout.cam_to_velo_path)
    yield from (layout.fisheye_path(camera) for camera in FISHEYE_CAMERAS)
    yield from (layout.poses_path, layout.cam0_to_world_path)
    yield from (layout.timestamps_path(kind) for kind in ("", "start", "end"))
    yield from (layout.camera_timestamps_path(camera) for camera in CAMERAS)
    yield from layout.boxes_paths


def _below(path: Path, layout: DriveLayout) -> str:
    return path.relative_to(layout.root).as_posix()
