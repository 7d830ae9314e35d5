"""Drives whose frames have times in seconds and whose poses are a path of their own rate.

A frame's instant is the middle of its sweep: where a recording stamps the sweep's begin, and its points have
times of their own, the instants are moved there, and the pose is the path's at that moment.
"""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from nvsf_core.drives.drive import AbstractDrive, DriveFacts, Recorded
from nvsf_core.drives.kitti360.calibration import Calibration
from nvsf_core.drives.kitti360.frames import (
    FIRST_DATE_S,
    NOMINAL_PERIOD_S,
    UNLIKE,
    FrameTimes,
    spaced_times,
    sweep_of,
)
from nvsf_core.drives.kitti360.scans import Scan
from nvsf_core.errors import DataError
from nvsf_core.geometry.se3 import pose_from_parts
from nvsf_core.sensors.sweep import Trajectory, sweep_by_points_s

_LONGEST_GAP_S = 1.5
"""Poses further apart say nothing of the path between them; those of a localisation of 1 Hz are nearer."""
_LEAST_SHIFT = 0.1
"""Least distance of the middle of a scan's times from its stamp, in sweeps, for the stamp to be moved."""
_LONGEST_SWEEP_S = 0.2
"""Of a LiDAR that rotates at 5 Hz, the slowest there is."""


@dataclass(frozen=True, slots=True, eq=False)
class PosePath:
    """Poses of a drive at times of their own."""

    time_s: np.ndarray
    """(n,) float64, ascending, on the clock of the frames."""
    poses: np.ndarray
    """(n, 4, 4) float64, pose frame to world, metres."""
    place: Path
    """Where they stand, for messages."""

    def at(self, time_s: float) -> np.ndarray | None:
        """The pose (4, 4) at a time; None outside of the path by more than a pose's step, or in a gap."""
        after = int(np.searchsorted(self.time_s, time_s))
        near = self.time_s[max(0, after - 1) : after + 1]
        exact = np.flatnonzero(np.abs(near - time_s) < 1e-9)
        if len(exact):
            return np.asarray(self.poses[max(0, after - 1) + int(exact[0])])
        if len(self.time_s) < 2:
            return None
        first = min(max(after - 1, 0), len(self.time_s) - 2)
        start_s, end_s = self.time_s[first : first + 2]
        spare_s = end_s - start_s
        if spare_s > _LONGEST_GAP_S or not start_s - spare_s <= time_s <= end_s + spare_s:
            return None
        place = pose_from_parts(np.eye(3), self.poses[first, :3, 3])
        path = Trajectory(self.time_s[first : first + 2], self.poses[first : first + 2], place)
        return np.asarray(place @ pose_from_parts(*path.at(np.array([time_s])))[0])


class AbstractPosedDrive(AbstractDrive):
    """A drive whose format gives times of frames and a path of poses."""

    @abstractmethod
    def frame_seconds(self) -> dict[int, float]:
        """Time of each frame that the whole drive has, seconds on any clock.

        Raises:
            DataError: They cannot be read, or do not ascend.
        """

    @abstractmethod
    def pose_path(self) -> PosePath | None:
        """The drive's poses; None if it has none.

        Raises:
            DataError: They cannot be read.
        """

    @abstractmethod
    def calibration(self) -> Calibration:
        """Mounting of the LiDAR and calibration of the scene's cameras.

        Raises:
            CalibrationError: It is absent or damaged.
        """

    @abstractmethod
    def has_scans(self) -> bool:
        """Whether the drive has a LiDAR."""

    @abstractmethod
    def recorded_sensor(self) -> str:
        """Name of the LiDAR's table as the drive says; empty = it does not."""

    @abstractmethod
    def _decoded(self, found: Recorded) -> Scan:
        """The scan with times after its stamp."""

    def decode_scan(self, frame: int) -> Scan | None:
        """A frame's scan with times after its stamp; None if there is none.

        Raises:
            DataError: It cannot be read.
        """
        found = self.find_scan(frame)
        return None if found is None else self._decoded(found)

    def parse_scan(self, found: Recorded) -> Scan:
        """Validate and decode a scan: points, intensity, ring and time after the frame's instant."""
        return self.centred(self._decoded(found))

    def why_no_pose(self, frame: int, place: str) -> str:
        """That the frame's time is not known, else see the base class."""
        if frame not in self._seconds:
            return f"no pose: its time is not known, {self.times_source} has no frame {frame}"
        return super().why_no_pose(frame, place)

    def image_seconds(self, camera: str) -> dict[int, float]:
        """Time of each image of a camera, by frame; empty = the frames' own, as they are recorded."""
        return {}

    def clock_zero_s(self) -> float | None:
        """Seconds from 1970-01-01 to 0 s of the drive's clock; None = not known.

        By default a clock whose frames would then be after the year 2000 counts from 1970.
        """
        return 0.0 if min(self._seconds.values(), default=0.0) >= FIRST_DATE_S else None

    @property
    def times_source(self) -> str:
        """Where the times stand, for messages."""
        return self.scene.root.name

    @cached_property
    def _seconds(self) -> dict[int, float]:
        return self.frame_seconds()

    given_path: PosePath | None = None
    """Poses that were found for a drive that has none."""

    @cached_property
    def _path(self) -> PosePath:
        path = self.given_path or self.pose_path()
        if path is None:
            raise DataError(
                f"scene {self.scene.name}: expected poses in {self.scene.root}, found none; "
                f"`nvsf import {self.scene.root} --out DRIVE` finds them from the scans (KISS-ICP)"
            )
        return path

    @cached_property
    def _first_scan(self) -> Scan | None:
        """The first scan of the section that can be read."""
        for frame in self.frames:
            try:
                scan = self.decode_scan(frame)
            except DataError:
                continue  # named where the frame itself is read
            if scan is not None:
                return scan
        return None

    @cached_property
    def stamp_shift_s(self) -> float:
        """Seconds from a scan's stamp to the middle of its sweep; 0 where points have no times."""
        scan = self._first_scan
        if scan is None or scan.offset_s is None:
            return 0.0
        middle_s = 0.5 * float(np.sum(np.percentile(scan.offset_s, [0.5, 99.5])))
        return middle_s if abs(middle_s) > _LEAST_SHIFT * self.times().sweep_period_s else 0.0

    def times(self) -> FrameTimes:
        """Times of the section's frames, and the duration of a sweep."""
        return self._times

    @cached_property
    def _times(self) -> FrameTimes:
        times = self._stamps()
        return replace(times, sweep_period_s=self._sweep_s(times.sweep_period_s))

    def _sweep_s(self, step_s: float) -> float:
        """Duration of a sweep: as given, else by a scan's times, where it is another than the step."""
        given_s, scan = self.scene.sweep_period_s, self._first_scan
        if given_s is None and scan is not None:
            given_s = sweep_by_points_s(scan.points, scan.offset_s, step_s)
        return sweep_of(given_s, step_s)

    def _pace_notes(self) -> list[str]:
        """What is assumed of sweeps that do not follow each other."""
        times = self.times()
        if not self.has_scans() or times.is_assumed or len(times.time_s) < 2:
            return []
        step_s, sweep_s = float(np.median(np.diff(times.time_s))), times.sweep_period_s
        if abs(sweep_s - step_s) > UNLIKE * step_s:
            return [f"a sweep lasts {sweep_s:.4g} s, frames are {step_s:.4g} s apart in the median"]
        if step_s > (1.0 + UNLIKE) * _LONGEST_SWEEP_S:
            return [
                f"frames are {step_s:.4g} s apart in the median, and a sweep is taken to last as long; a "
                f"LiDAR's lasts {_LONGEST_SWEEP_S:g} s at most: give sweep_period_s in the catalogue"
            ]
        return []

    def _stamps(self) -> FrameTimes:
        known = {frame: self._seconds[frame] for frame in self.frames if frame in self._seconds}
        if not known:
            raise DataError(
                f"scene {self.scene.name}: expected frames {self.frames[0]} to {self.frames[-1]} in "
                f"{self.scene.root}, found {_span(sorted(self._seconds))}; correct first_frame and last_frame"
            )
        usual_s = median_step_s([self._seconds[frame] for frame in sorted(self._seconds)])
        period_s = self.scene.sweep_period_s or usual_s or NOMINAL_PERIOD_S
        frames = np.array(sorted(known))
        seconds = np.array([known[frame] for frame in frames.tolist()])
        wanted = np.array(self.frames)
        # A frame that is not there is given a time between its neighbours'; it has no scan and no pose.
        step_s = usual_s or period_s
        step_s = step_s if abs(period_s - step_s) > UNLIKE * step_s else period_s
        found = np.interp(wanted, frames, seconds)
        found = np.where(wanted < frames[0], seconds[0] - step_s * (frames[0] - wanted), found)
        found = np.where(wanted > frames[-1], seconds[-1] + step_s * (wanted - frames[-1]), found)
        return spaced_times(found - found[0], period_s, self.times_source)

    def _own_moment_s(self, camera: str, frame: int) -> float | None:
        """When an image was taken, where that is another moment than the instant of its frame's pose.

        Without times of its own it has the frame's, as recorded: only the scan's instant is moved.
        """
        seconds = self.image_seconds(camera)
        if not seconds and self.stamp_shift_s:
            seconds = self._seconds
        return seconds.get(frame)

    def image_delay_s(self, camera: str, frame: int) -> float | None:
        """Seconds from the instant of a frame's pose to the image; None where it is of that instant."""
        moment_s, instant_s = self._own_moment_s(camera, frame), self.instant_s(frame)
        return None if moment_s is None or instant_s is None else moment_s - instant_s

    def instant_s(self, frame: int) -> float | None:
        """The instant of a frame's pose on the drive's clock; None if the drive has no such frame."""
        stamp_s = self._seconds.get(frame)
        return None if stamp_s is None else stamp_s + self.stamp_shift_s

    @property
    def boxes_after_s(self) -> float:
        """Seconds from a frame's instant to its labels: they are of its time as recorded, as images are."""
        return 0.0 - self.stamp_shift_s

    def facts(self) -> DriveFacts:
        """Calibration, poses and times.

        Raises:
            DataError: No frame has a pose; and see the base class.
        """
        path, times = self._path, self.times()
        poses, lost_s = {}, []
        for frame in self.frames:
            moment_s = self.instant_s(frame)
            if moment_s is None:
                continue
            pose = path.at(moment_s)
            if pose is None:
                lost_s.append(moment_s)
            else:
                poses[frame] = pose
        notes = [*self._pace_notes(), *self._lost_poses(lost_s, len(poses))]
        if self.stamp_shift_s:
            notes.append(
                f"scans are stamped {1000.0 * self.stamp_shift_s:.1f} ms before the middle of their sweep: "
                "poses are those of the middle"
            )
        times = replace(times, origin_s=self._origin_s())
        named = self.scene.lidar or self.recorded_sensor()
        return DriveFacts(
            calibration=self.calibration(), poses=poses, poses_place=path.place, times=times,
            has_scans=self.has_scans(), sensor="" if named == "found" else named, notes=tuple(notes),
            boxes_after_s=self.boxes_after_s,
        )  # fmt: skip

    def _origin_s(self) -> float | None:
        """Seconds from 1970-01-01 to the first frame's instant; None = not known."""
        zero_s, times = self.clock_zero_s(), self.times()
        known = next((frame for frame in self.frames if frame in self._seconds), None)
        if zero_s is None or known is None or times.is_assumed:
            return None
        later_s = float(times.time_s[known - self.frames[0]])
        return zero_s + self._seconds[known] + self.stamp_shift_s - later_s

    def _lost_poses(self, lost_s: list[float], found: int) -> list[str]:
        """A note on frames at whose instants, in seconds, the path has no pose, next to so many that have.

        Raises:
            DataError: No frame has one.
        """
        if not lost_s:
            return []
        path, frames = self._path, f"{len(lost_s)} of {len(lost_s) + found} frames have no pose"
        steps_s = np.diff(path.time_s) if len(path.time_s) > 1 else np.array([np.inf])
        words = (
            f"{frames}, the first at {lost_s[0]:.3f} s: expected poses at most {_LONGEST_GAP_S:g} s apart on "
            f"both sides of a frame's instant; {path.place.name} has {len(path.time_s)} from "
            f"{path.time_s[0]:.3f} to {path.time_s[-1]:.3f} s, {np.median(steps_s):.3g} s apart in the "
            f"median, at most {steps_s.max():.3g} s"
        )
        if found:
            return [words]
        raise DataError(
            f"scene {self.scene.name}: {words}; give poses at a higher rate and of the same clock, or remove "
            f"them: `nvsf import {self.scene.root} --out DRIVE` then finds them from the scans (KISS-ICP)"
        )

    def path_of_section(self) -> PosePath | None:
        """The path's own poses within a gap's length of the section, on the clock of `times`.

        None where that clock is assumed: what lies between frames is then not known.
        """
        known = [frame for frame in self.frames if self.instant_s(frame) is not None]
        times, path = self.times(), self._path
        if times.is_assumed or not known:
            return None
        later_s = (
            path.time_s - float(self.instant_s(known[0]) or 0.0) + times.time_s[known[0] - self.frames[0]]
        )
        is_near = (later_s > -_LONGEST_GAP_S) & (later_s < times.time_s[-1] + _LONGEST_GAP_S)
        return PosePath(later_s[is_near], path.poses[is_near], path.place)

    def places_m(self) -> np.ndarray:
        """Positions of the path."""
        path = self.pose_path()
        return np.zeros((0, 3)) if path is None else np.asarray(path.poses[:, :3, 3])

    def pose_at_image(self, camera: str, frame: int, pose: np.ndarray) -> np.ndarray:
        """The path's pose at the image's own time, if it has one."""
        moment_s = self._own_moment_s(camera, frame)
        if moment_s is None:
            return pose
        found = self._path.at(moment_s)
        if found is None:
            raise DataError(f"no pose at the time of the image, {moment_s:.6f} s, in {self._path.place.name}")
        return found

    def centred(self, scan: Scan) -> Scan:
        """A scan with times after the frame's instant instead of its stamp."""
        if scan.offset_s is None or not self.stamp_shift_s:
            return scan
        return Scan(scan.points, scan.n_absurd, scan.ring, scan.offset_s - self.stamp_shift_s)


def require_ascending(values: np.ndarray, where: str, line_of: Callable[[int], int]) -> None:
    """Refuse times, or frames, (n,) that do not ascend.

    Args:
        values: In the order of the file.
        where: The file, for the message.
        line_of: Number of the line that the value of an index stands in.

    Raises:
        DataError: One is not larger than the one before.
    """
    late = np.flatnonzero(np.diff(values) <= 0.0)
    if len(late):
        k = int(late[0]) + 1
        raise DataError(
            f"{where}: expected ascending times, found {values[k]:.16g} in line {line_of(k)}, after "
            f"{values[k - 1]:.16g}; sort the rows, and keep one of each time"
        )


def median_step_s(ascending_s: list[float]) -> float | None:
    """Median time from one to the next; None if there are not two."""
    return float(np.median(np.diff(ascending_s))) if len(ascending_s) > 1 else None


def _span(frames: list[int]) -> str:
    return f"{frames[0]} to {frames[-1]}" if frames else "none"
