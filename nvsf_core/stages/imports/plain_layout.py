"""An imported drive as plain files."""

from collections.abc import Mapping, Sequence
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

_SAME_S = 1e-6
"""Poses nearer in time than this are one: a car drives some micrometres meanwhile."""


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
        write_description(
            layout, facts.sensor, facts.notes, facts.times, facts.boxes_after_s if boxes else 0.0
        )
        frames = range(self.scene.first_frame, self.scene.last_frame + 1)
        time_s = dict(zip(frames, facts.times.time_s.tolist(), strict=True))
        posed = sorted(facts.poses)
        own = {time_s[frame]: facts.poses[frame] for frame in posed}
        path = self._with_path_between(own)
        moments_s = sorted(path)
        # Of frames alone, each row says of which.
        write_poses(
            layout, posed if len(path) == len(own) else None, moments_s,
            [path[one] @ lidar_to_pose for one in moments_s],
        )  # fmt: skip
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

    def _with_path_between(self, own: Mapping[float, np.ndarray]) -> Mapping[float, np.ndarray]:
        """Poses by their time: the frames' own, and where the path has others, those and the images'."""
        path = self.path
        if path is None or not own:
            return own
        rows = dict(zip(path.time_s.round(9).tolist(), path.poses, strict=True))
        if not any(min(own) < one < max(own) for one in _apart(rows, own)):
            return own
        moments = {round(one, 9) for times in self._image_times.values() for one in times.values()}
        at_images = {one: pose for one in moments if (pose := path.at(one)) is not None}
        own = {**own, **_apart(at_images, own)}
        return {**own, **_apart(rows, own)}

    def catalogue_lines(self) -> list[str]:
        """Kind and, where the drive has no sweep of its own, its period."""
        return ['kind = "plain"', f"sweep_period_s = {self.facts.times.sweep_period_s:.6g}"]


def _apart(poses: Mapping[float, np.ndarray], known: Mapping[float, np.ndarray]) -> dict[float, np.ndarray]:
    """Those poses whose times, in seconds, are no known one's, of which there is at least one."""
    if not poses:
        return {}
    times_s, moments_s = np.array(sorted(known)), np.array(list(poses))
    after = np.searchsorted(times_s, moments_s)
    near_s = times_s[np.clip(np.stack([after - 1, after]), 0, len(times_s) - 1)]
    is_apart = np.abs(near_s - moments_s).min(axis=0) > _SAME_S
    return {one: pose for (one, pose), keep in zip(poses.items(), is_apart.tolist(), strict=True) if keep}
