"""Plans of synthetic views: their times, poses and sensors."""

from dataclasses import dataclass

import numpy as np

from nvsf_core.errors import MissingFrameError
from nvsf_core.sensors.tables import LaserTable, sensor_table


@dataclass(frozen=True, slots=True)
class ViewPlan:
    """Instants and mounting of a view, for any sensor."""

    name: str
    frame: np.ndarray
    """(n,) int64: the recorded frame nearest in time to each instant."""
    time_s: np.ndarray
    """(n,) float64: instants of the poses, seconds since the first frame."""
    mount: np.ndarray | None
    """(4, 4) pose of the LiDAR (cameras move with it) in its own recorded frame; None = the recorded pose."""


@dataclass(frozen=True, slots=True)
class SweepPlan(ViewPlan):
    """Instants, mounting and LiDAR of a view."""

    table: LaserTable
    """The simulated sensor."""
    is_recorded_sensor: bool
    """Whether it is the recording sensor, with the own vehicle around it."""


def mount_pose(shift_m: tuple[float, float, float], yaw_deg: float) -> np.ndarray | None:
    """Pose (4, 4) of a sensor shifted by (forward, left, up) and turned to the left; None if both are 0."""
    if not any(shift_m) and yaw_deg == 0.0:
        return None
    angle = np.deg2rad(yaw_deg)
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    pose[:3, 3] = shift_m
    return pose


def plan_view(
    name: str,
    *,
    recorded_frame: np.ndarray,
    recorded_time_s: np.ndarray,
    frames: tuple[int, ...] | None,
    times_s: tuple[float, ...] | None = None,
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
    return ViewPlan(
        name=name,
        frame=recorded_frame[nearest].astype(np.int64),
        time_s=time_s,
        mount=mount_pose(shift_m, yaw_deg),
    )


def plan_sweeps(view: ViewPlan, recorded_table: LaserTable, sensor: str | None) -> SweepPlan:
    """The sweeps of a view, by the sensor of that name; None = the one that recorded the drive."""
    other = None if sensor in (None, recorded_table.name) else sensor
    table = recorded_table if other is None else sensor_table(other)
    return SweepPlan(view.name, view.frame, view.time_s, view.mount, table, other is None)
