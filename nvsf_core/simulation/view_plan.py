"""Plans of synthetic views: their times, poses and sensors.

A view has two clocks. The scene's says where everything that moves is; the path's says where the sensor is.
On a recorded drive both are one. While an instant is frozen, the scene's stands and the path's goes on.
"""

from dataclasses import dataclass, field, fields, replace
from typing import Self

import numpy as np

from nvsf_core.errors import MissingFrameError
from nvsf_core.geometry.se3 import pose_from_parts
from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.sensors.tables import LaserTable, sensor_table


@dataclass(frozen=True, slots=True)
class ViewPlan:
    """Instants and mounting of a view, for any sensor."""

    name: str
    frame: np.ndarray
    """(n,) int64: the recorded frame whose pose is the nearest one to each instant's."""
    time_s: np.ndarray
    """(n,) float64: instants of the scene, seconds since the first frame."""
    mount: np.ndarray | None
    """(4, 4) pose of the LiDAR (cameras move with it) in the path's frame; None = the path's own pose."""
    path_time_s: np.ndarray | None = field(default=None, kw_only=True)
    """(n,) float64: moments of the path at which the sensor is there; None = `time_s`."""
    path: Trajectory | None = field(default=None, kw_only=True)
    """Where the sensor goes; None = the recorded path."""
    near_s: np.ndarray | None = field(default=None, kw_only=True)
    """(n,) float64: times at which the drive was nearest to each pose: what is static is looked up in their
    scans and images. None = `time_s`."""
    scene_rate: float = field(default=1.0, kw_only=True)
    """Seconds of the scene that go by in a second of the sensor's: 1 as recorded, 0 = frozen."""
    path_rate: float = field(default=1.0, kw_only=True)
    """Seconds of the path that go by in a second of the sensor's."""

    @property
    def is_as_recorded(self) -> bool:
        """Whether sensor and scene move as they did in the drive, but for the mounting."""
        return self.path is None and self.path_time_s is None and self.scene_rate == self.path_rate == 1.0

    @property
    def moments_s(self) -> np.ndarray:
        """(n,) float64 moments of the path."""
        return self.time_s if self.path_time_s is None else self.path_time_s

    @property
    def stamp_s(self) -> np.ndarray:
        """(n,) float64 times on the sensor's own clock, by which its files are stamped.

        The first is the path's moment.
        """
        moments = self.moments_s
        first = float(moments[0]) if len(moments) else 0.0
        return np.asarray(first + (moments - first) / self.path_rate)

    def only(self, number: int) -> Self:
        """The plan of one of the instants."""
        part = slice(number, number + 1)
        own_s = None if self.path_time_s is None else self.path_time_s[part]
        near_s = None if self.near_s is None else self.near_s[part]
        return replace(
            self, frame=self.frame[part], time_s=self.time_s[part], path_time_s=own_s, near_s=near_s
        )

    @property
    def near(self) -> np.ndarray:
        """(n,) float64 times at which the drive was nearest to each pose."""
        return self.time_s if self.near_s is None else self.near_s

    def near_time_s(self, time_s: float) -> float:
        """When the drive was nearest to the pose of a plan's only instant `time_s`."""
        return time_s if self.near_s is None else float(self.near_s[0])

    def moment_s(self, time_s: float) -> float:
        """Moment of the path of a plan's only instant `time_s`."""
        return time_s if self.path_time_s is None else float(self.path_time_s[0])

    def poses(self, recorded: Trajectory) -> np.ndarray:
        """(n, 4, 4) scene-local poses of the view's LiDAR; `recorded` is the drive's path."""
        poses = pose_from_parts(*(self.path or recorded).at(self.moments_s))
        return poses if self.mount is None else poses @ self.mount


@dataclass(frozen=True, slots=True)
class SweepPlan(ViewPlan):
    """Instants, mounting and LiDAR of a view."""

    table: LaserTable
    """The simulated sensor."""
    is_recorded_sensor: bool
    """Whether it is the recording sensor, with the own vehicle around it."""
    period_s: float | None = field(default=None, kw_only=True)
    """Duration of a sweep; None = the recorded one."""

    def sweep_s(self, recorded_s: float) -> float:
        """Duration of a sweep on the sensor's clock; `recorded_s`, 0 without compensation, is the drive's."""
        return recorded_s if self.period_s is None or recorded_s == 0.0 else self.period_s

    def fired_s(self, time_s: float, fraction: np.ndarray, recorded_s: float) -> np.ndarray:
        """(r,) instants of the scene at which rays are fired.

        Args:
            time_s: The sweep's instant.
            fraction: (r,) sweeps after it.
            recorded_s: Duration of a recorded sweep.
        """
        return np.asarray(time_s + fraction * (self.sweep_s(recorded_s) * self.scene_rate))


def mount_pose(shift_m: tuple[float, float, float], yaw_deg: float) -> np.ndarray | None:
    """Pose (4, 4) of a sensor shifted by (forward, left, up) and turned to the left; None if both are 0."""
    if not any(shift_m) and yaw_deg == 0.0:
        return None
    angle = np.deg2rad(yaw_deg)
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    pose[:3, 3] = shift_m
    return pose


# Wide: where, when and how are independent choices of a view.
def plan_view(
    name: str,
    *,
    recorded_frame: np.ndarray,
    recorded_time_s: np.ndarray,
    frames: tuple[int, ...] | None,
    times_s: tuple[float, ...] | None = None,
    frozen_at_s: float | None = None,
    shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    yaw_deg: float = 0.0,
) -> ViewPlan:
    """Plan instants and mounting of a view.

    Args:
        name: Name of the view.
        recorded_frame: (m,) numbers of the frames with a pose, ascending.
        recorded_time_s: (m,) their times, seconds since the first frame.
        frames: Frame numbers of the view; None = all.
        times_s: Times of the view, instead of frames.
        frozen_at_s: Instant of the scene in all of them; the sensor is where it was at its frames or times.
        shift_m: Shift of the sensor: forward, left, up.
        yaw_deg: Turn of the sensor to the left.

    Raises:
        MissingFrameError: A frame that is asked for has no pose.
    """
    if times_s is not None:
        time_s = np.asarray(times_s, np.float64)
    else:
        wanted = recorded_frame if frames is None else np.asarray(frames, np.int64)
        missing = sorted(set(wanted.tolist()) - set(recorded_frame.tolist()))
        if missing:
            raise MissingFrameError(
                f"view {name!r}: expected frames with a pose, found none for {missing}; ask for others of "
                f"{recorded_frame.min()}..{recorded_frame.max()}"
            )
        time_s = recorded_time_s[np.searchsorted(recorded_frame, wanted)]
    nearest = np.abs(recorded_time_s[None, :] - time_s[:, None]).argmin(axis=1)
    view = ViewPlan(
        name=name, frame=recorded_frame[nearest].astype(np.int64), time_s=time_s,
        mount=mount_pose(shift_m, yaw_deg),
    )  # fmt: skip
    if frozen_at_s is None:
        return view
    return replace(
        view, time_s=np.full(len(time_s), frozen_at_s), path_time_s=time_s, near_s=time_s, scene_rate=0.0
    )


def plan_sweeps(view: ViewPlan, recorded_table: LaserTable, sensor: str | None) -> SweepPlan:
    """The sweeps of a view, by the sensor of that name; None = the one that recorded the drive."""
    other = None if sensor in (None, recorded_table.name) else sensor
    table = recorded_table if other is None else sensor_table(other)
    same = {one.name: getattr(view, one.name) for one in fields(ViewPlan)}
    return SweepPlan(**same, table=table, is_recorded_sensor=other is None)
