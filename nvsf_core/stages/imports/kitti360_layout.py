"""An imported drive in KITTI-360's layout: four cameras, of which two may be fisheyes; no rings or times.

Points that were stamped one by one, or numbered by their lasers, lose that here: a plain drive keeps it. What
is lost is said.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np

from nvsf_core.drives.drive import DriveFacts
from nvsf_core.drives.entries import SceneEntry
from nvsf_core.drives.kitti360.boxes import Box
from nvsf_core.drives.kitti360.calibration import CameraCalibration
from nvsf_core.drives.kitti360.layout import CAMERAS, FISHEYE_CAMERAS, PERSPECTIVE_CAMERAS, DriveLayout
from nvsf_core.drives.kitti360.scans import Scan, write_scan
from nvsf_core.drives.kitti360.writer import (
    MOST_LINES_BEFORE,
    write_boxes,
    write_calibration,
    write_frame_poses,
    write_image,
    write_times,
)
from nvsf_core.errors import DataError
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.geometry.se3 import invert_pose
from nvsf_core.stages.exports.camera_places import in_free_places
from nvsf_core.stages.exports.kitti360 import object_numbers
from nvsf_core.stages.imports.target import AbstractTarget

_LEAST_DELAY_S = 1e-4
"""Of an image from its frame, for it to be a loss: at 30 m/s it is 3 mm."""


class Kitti360Target(AbstractTarget):
    """Writes a KITTI-360 root of one sequence."""

    def __init__(self, folder: Path, scene: SceneEntry, facts: DriveFacts) -> None:
        super().__init__(folder, scene, facts)
        self._scans_with = {"rings": 0, "times": 0}
        self._largest_delay_s: dict[str, float] = {}

    @property
    def _layout(self) -> DriveLayout:
        return DriveLayout(self.folder, self.scene.sequence)

    @cached_property
    def _names(self) -> Mapping[str, str]:
        """Recorded camera to its name in the layout."""
        return layout_names(self.facts.calibration.cameras)

    @property
    def cameras(self) -> tuple[str, ...]:
        """Those that have a place."""
        return tuple(self._names)

    def write_scan(self, frame: int, scan: Scan) -> None:
        """Write a `.bin`."""
        self._scans_with["rings"] += scan.ring is not None
        self._scans_with["times"] += scan.offset_s is not None
        write_scan(self._layout.scan_path(frame), scan.points[:, :3], scan.points[:, 3])

    def write_image(self, camera: str, frame: int, rgb: np.ndarray, time_s: float | None) -> None:
        """Write a PNG; the layout takes images to be of their frame's instant."""
        write_image(self._layout.image_path(self._names[camera], frame), rgb)
        if time_s is not None:
            delay_s = abs(time_s - float(self.facts.times.time_s[frame - self.scene.first_frame]))
            self._largest_delay_s[camera] = max(delay_s, self._largest_delay_s.get(camera, 0.0))

    def finish(self, boxes: Sequence[Box]) -> None:
        """Write calibration, poses, timestamps and boxes."""
        layout, facts = self._layout, self.facts
        own = facts.calibration.cameras
        cameras = {there: own[here] for here, there in self._names.items()}
        lidar_to_pose = facts.calibration.lidar_to_pose
        # The LiDAR's mounting is given by that of camera 0, so without images one is assumed in its place.
        to_pose = {"image_00": lidar_to_pose} | {name: camera.to_pose for name, camera in cameras.items()}
        models = {name: camera.intrinsics for name, camera in cameras.items()}
        write_calibration(layout, models, to_pose, invert_pose(lidar_to_pose) @ to_pose["image_00"])
        posed = sorted(facts.poses)
        poses = np.array([facts.poses[frame] for frame in posed]).reshape(-1, 4, 4)
        write_frame_poses(layout.poses_path, posed, poses, rows=3)
        if "image_00" in cameras:
            write_frame_poses(layout.cam0_to_world_path, posed, poses @ cameras["image_00"].to_pose, rows=4)
        self._write_times()
        self._write_boxes(boxes)
        self.left_out += self._losses(boxes)
        self.notes += self._renames()

    def _write_times(self) -> None:
        """Write the timestamps; assumed ones are not written: a tree without them says so."""
        facts, first = self.facts, self.scene.first_frame
        if facts.times.is_assumed:
            return
        sweep_s = facts.times.sweep_period_s
        # A line a frame from frame 0, also before the section; readers take a cut drive's own lines, too.
        before = first if first <= MOST_LINES_BEFORE else 0
        own_s = first * sweep_s + facts.times.time_s
        stamps = np.concatenate([sweep_s * np.arange(before), own_s])
        # Scans of one instant begin when they end: so they are known when the tree is read.
        known_s = facts.times.origin_s
        origin_s = None if known_s is None else known_s - first * sweep_s
        write_times(self._layout, (), stamps, sweep_s if self.scene.is_to_compensate else 0.0, origin_s)
        if before < first:
            self.notes.append(
                f"timestamps have lines of frames {first} to {self.scene.last_frame} alone, none for "
                f"the {first:,} before"
            )

    def _renames(self) -> list[str]:
        """Which camera is called what, and which pinhole is written as a fisheye, in words."""
        own = self.facts.calibration.cameras
        is_flat = {name: isinstance(own[name].intrinsics, Pinhole) for name in self._names}
        return [
            f"camera {name} is {there} of the layout"
            + (", as a MEI camera with xi = 0" if is_flat[name] and there in FISHEYE_CAMERAS else "")
            for name, there in self._names.items()
            if name != there or (is_flat[name] and there in FISHEYE_CAMERAS)
        ]

    def _write_boxes(self, boxes: Sequence[Box]) -> None:
        try:
            numbers = object_numbers({one.object_id: one.label for one in boxes})
        except DataError as error:
            self.left_out.append(f"all boxes: {error}")
            boxes, numbers = (), {}
        written = [replace(one, object_id=numbers[one.object_id]) for one in boxes]
        frames = self.scene.first_frame, self.scene.last_frame
        write_boxes(self._layout.boxes_path("train"), written, *frames)

    def _losses(self, boxes: Sequence[Box]) -> list[str]:
        """What the layout has no place for, in words."""
        facts = self.facts
        lost = [
            f"camera {name}: the layout has {len(CAMERAS)} cameras, of which {len(FISHEYE_CAMERAS)} may be "
            "fisheyes, taken by others"
            for name in facts.calibration.cameras if name not in self._names
        ]  # fmt: skip
        lost += [
            f"times of images of {camera}, up to {1000.0 * delay_s:.1f} ms from their frames': the layout "
            "takes images to be of their frame's instant"
            for camera, delay_s in self._largest_delay_s.items() if delay_s > _LEAST_DELAY_S
        ]  # fmt: skip
        if facts.boxes_after_s and any(one.dynamic for one in boxes):
            lost.append(
                f"times of boxes, {1000.0 * facts.boxes_after_s:.1f} ms from their frames': the layout takes "
                "boxes to be of their frame's instant"
            )
        lost += [
            f"{what} of the points of {count} scans: the layout has no place for them"
            for what, count in self._scans_with.items() if count
        ]  # fmt: skip
        return [f"{words}; --layout plain keeps this" for words in lost]

    def catalogue_lines(self) -> list[str]:
        """Sequence and period."""
        lidar = self.facts.sensor or "found"
        return [
            f'sequence = "{self.scene.sequence}"',
            f'lidar = "{lidar}"',
            f"sweep_period_s = {self.facts.times.sweep_period_s:.6g}",
        ]


def layout_names(cameras: Mapping[str, CameraCalibration]) -> dict[str, str]:
    """Recorded camera to its name in the layout; those that find no place are left out.

    One that has a name of the layout keeps it: a pinhole a fisheye's, as of KITTI's colour cameras, only
    beside an `image_00`, since a pinhole's place keeps its pixels as they are. Others take what is free.
    """
    flat = [name for name, one in cameras.items() if isinstance(one.intrinsics, Pinhole)]
    curved = [name for name in cameras if name not in flat]
    own = {name: name for name in flat if name in PERSPECTIVE_CAMERAS}
    own |= {name: name for name in curved if name in FISHEYE_CAMERAS}
    own |= in_free_places(curved, FISHEYE_CAMERAS, own)
    if PERSPECTIVE_CAMERAS[0] in own:
        free = set(FISHEYE_CAMERAS) - set(own.values())
        own |= {name: name for name in flat if name in free}
    own |= in_free_places(flat, CAMERAS, own)
    return {name: own[name] for name in cameras if name in own}
