"""An imported drive as plain files."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nvsf_core.drives.drive import DriveFacts
from nvsf_core.drives.entries import SceneEntry
from nvsf_core.drives.kitti360.boxes import Box
from nvsf_core.drives.kitti360.scans import Scan
from nvsf_core.drives.plain.layout import PlainLayout
from nvsf_core.drives.plain.writer import (
    write_cameras,
    write_description,
    write_frame_times,
    write_image_times,
    write_plain_boxes,
    write_plain_image,
    write_plain_scan,
    write_poses,
)
from nvsf_core.geometry.se3 import invert_pose
from nvsf_core.stages.imports.target import AbstractTarget


class PlainTarget(AbstractTarget):
    """Writes docs/drives.md's folder."""

    def __init__(self, folder: Path, scene: SceneEntry, facts: DriveFacts) -> None:
        super().__init__(folder, scene, facts)
        self._image_times: dict[str, dict[int, float]] = {}

    @property
    def _layout(self) -> PlainLayout:
        return PlainLayout(self.folder)

    def write_scan(self, frame: int, scan: Scan) -> None:
        """Write `.bin`, with ring and time beside it."""
        write_plain_scan(self._layout, frame, scan)

    def write_image(self, camera: str, frame: int, rgb: np.ndarray, time_s: float | None) -> None:
        """Write a PNG, and remember its time."""
        write_plain_image(self._layout, camera, frame, rgb)
        if time_s is not None:
            self._image_times.setdefault(camera, {})[frame] = time_s

    def finish(self, boxes: Sequence[Box]) -> None:
        """Write the tables."""
        facts, layout = self.facts, self._layout
        lidar_to_pose = facts.calibration.lidar_to_pose
        write_description(layout, facts.sensor, facts.notes)
        frames = range(self.scene.first_frame, self.scene.last_frame + 1)
        time_s = dict(zip(frames, facts.times.time_s.tolist(), strict=True))
        posed = sorted(facts.poses)
        write_poses(
            layout, posed, [time_s[one] for one in posed], [facts.poses[one] @ lidar_to_pose for one in posed]
        )
        write_frame_times(layout, time_s)
        to_lidar = invert_pose(lidar_to_pose)
        write_cameras(
            layout,
            {
                name: (one.intrinsics, to_lidar @ one.to_pose)
                for name, one in facts.calibration.cameras.items()
            },
        )
        for camera, moments in self._image_times.items():
            write_image_times(layout, camera, moments)
        write_plain_boxes(layout, boxes)

    def catalogue_lines(self) -> list[str]:
        """Kind and, where the drive has no sweep of its own, its period."""
        return ['kind = "plain"', f"sweep_period_s = {self.facts.times.sweep_period_s:.6g}"]
