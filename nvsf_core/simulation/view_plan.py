"""Plans of synthetic views: their times, poses and sensors; and a path of their own, if they have one.

A view has two clocks. The scene's says where everything that moves is; the path's says where the sensor is.
On a recorded drive both are one. While an instant is frozen, the scene's stands and the path's goes on.
"""

from dataclasses import dataclass, field, fields, replace
from typing import Self

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from nvsf_core.drives.view_checks import moments_s
from nvsf_core.drives.view_entry import ViewEntry
from nvsf_core.drives.view_parts import SensorEntry
from nvsf_core.errors import DataError, MissingFrameError
from nvsf_core.geometry.se3 import exp_se3, invert_pose, log_se3, pose_from_parts, pose_of_angles
from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.sensors.tables import LaserTable, sensor_table

_SAME_S = 1e-6
"""Times nearer to each other are one."""
_STEP_S = 0.02
"""Time between the poses that a smooth curve is cut into; between them the motion is constant."""
_MOST_KNOTS = 100_000
_BESIDE_M = 4.0
"""So much farther away than the nearest recorded place, another one is beside it: on the other lane."""
_SAME_WAY = 0.5
"""Cosine of the angle between two ways to look: up to 60 degrees it is the same way, beyond 120 the other."""
_SPARE_S = 1.0
"""Both ends go on unchanged for so long: a sweep begins before its pose's instant."""


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
    is_at_frames: bool = field(default=True, kw_only=True)
    """Whether the moments are those of recorded frames, each once: then files have their numbers."""
    near_s: np.ndarray | None = field(default=None, kw_only=True)
    """(n,) float64: times at which the drive was nearest to each pose: what is static is looked up in their
    scans and images. None = `time_s`."""
    scene_rate: float = field(default=1.0, kw_only=True)
    """Seconds of the scene that go by in a second of the sensor's: 1 as recorded, 0 = frozen."""
    path_rate: float = field(default=1.0, kw_only=True)
    """Seconds of the path that go by in a second of the sensor's."""
    given_poses: np.ndarray | None = field(default=None, kw_only=True)
    """(n, 4, 4) scene-local poses that the drive itself gives the LiDAR at these instants: they may lie off
    the path between its frames' poses, and beyond its ends. None = those of the path, mounted."""

    @property
    def is_as_recorded(self) -> bool:
        """Whether sensor and scene move as they did in the drive, but for the mounting."""
        return self.path is None and self.path_time_s is None and self.scene_rate == self.path_rate == 1.0

    @property
    def tilt_rad(self) -> float:
        """Angle between the sensor's upward axis and the path's: 0 if it is only shifted and turned aside."""
        if self.mount is None:
            return 0.0
        return float(np.arctan2(np.hypot(*self.mount[:2, 2]), self.mount[2, 2]))

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

    @property
    def number(self) -> np.ndarray:
        """(n,) int64 numbers of the files: of the frames, or counted from 0 between them."""
        return self.frame if self.is_at_frames else np.arange(len(self.frame))

    def only(self, number: int) -> Self:
        """The plan of one of the instants."""
        names = ("frame", "time_s", "path_time_s", "near_s", "given_poses")
        given = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        return replace(self, **{name: values[number : number + 1] for name, values in given.items()})

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
        if self.given_poses is not None:
            return self.given_poses
        poses = pose_from_parts(*(self.path or recorded).at(self.moments_s))
        return poses if self.mount is None else poses @ self.mount


@dataclass(frozen=True, slots=True)
class SweepPlan(ViewPlan):
    """Instants, mounting and LiDAR of a view."""

    table: LaserTable
    is_recorded_sensor: bool
    """Whether it is the recording sensor, with the own vehicle around it."""
    period_s: float | None = field(default=None, kw_only=True)
    """Duration of a sweep; None = the recorded one."""
    has_footprint: bool = field(default=False, kw_only=True)
    """Whether beams have the width of the table."""

    def sweep_s(self, recorded_s: float) -> float:
        """Duration of a sweep on the sensor's clock; `recorded_s`, 0 without compensation, is the drive's."""
        return recorded_s if self.period_s is None or recorded_s == 0.0 else self.period_s

    def fired_s(self, time_s: float, elapsed: np.ndarray, recorded_s: float) -> np.ndarray:
        """(r,) instants of the scene at which rays are fired, `elapsed` sweeps after that of the sweep."""
        return np.asarray(time_s + elapsed * (self.sweep_s(recorded_s) * self.scene_rate))


def recorded_sweep(table: LaserTable, time_s: float, mount: np.ndarray | None = None) -> SweepPlan:
    """One sweep of the recording sensor on the recorded path, at `time_s` after the first frame.

    `mount` is its pose (4, 4) in its recorded frame; None = in its own place.
    """
    return SweepPlan("recorded", np.zeros(1, np.int64), np.array([time_s]), mount, table, True)


def mount_pose(view: ViewEntry) -> np.ndarray | None:
    """Pose (4, 4) of a view's LiDAR in the path's frame, by its shift and angles; None if all are 0."""
    if not any((*view.shift_m, view.yaw_deg, view.pitch_deg, view.roll_deg)):
        return None
    return pose_of_angles(view.shift_m, view.yaw_deg, view.pitch_deg, view.roll_deg)


def plan_view(
    view: ViewEntry, recorded_frame: np.ndarray, recorded_time_s: np.ndarray, recorded: Trajectory
) -> ViewPlan:
    """Plan instants and poses of a view.

    Of the frames with a pose: numbers (m,), ascending, and times (m,), seconds since the first frame.

    Raises:
        MissingFrameError: A frame that is asked for has no pose, or no instant lies in drive and path.
    """
    try:
        moments = moments_s(view, recorded_frame, recorded_time_s)
    except DataError as error:
        raise MissingFrameError(f"view {view.name!r}: {error}") from error
    start = recorded.scene_to_world @ pose_from_parts(*recorded.at(recorded_time_s[:1]))[0]
    path = view_path(view, start, recorded.scene_to_world)
    mount = mount_pose(view)
    near_s = moments if path is None else _nearest_s(path, moments, mount, recorded, recorded_time_s)
    is_frozen = view.frozen_at_s is not None
    nearest = np.abs(recorded_time_s[None, :] - near_s[:, None]).argmin(axis=1)
    return ViewPlan(
        view.name,
        recorded_frame[nearest].astype(np.int64),
        np.full(len(moments), view.frozen_at_s) if is_frozen else moments,
        mount,
        path_time_s=moments if is_frozen else None,
        path=path,
        is_at_frames=bool(
            path is None
            and len(np.unique(nearest)) == len(nearest)
            and (np.abs(recorded_time_s[nearest] - moments) < _SAME_S).all()
        ),
        near_s=near_s if is_frozen or path is not None else None,
        scene_rate=0.0 if is_frozen else float(view.speed),
        path_rate=float(view.speed),
    )


def _nearest_s(
    path: Trajectory,
    moments: np.ndarray,
    mount: np.ndarray | None,
    recorded: Trajectory,
    recorded_time_s: np.ndarray,
) -> np.ndarray:
    """Times (n,) of the recorded poses that are nearest in place to a path at its moments (n,).

    Where the nearest one looks the other way, as on a road that is driven there and back, and one beside it
    looks the same way, that one is taken: it saw the sides of things that the view shows. `mount` (4, 4) is
    the sensor's pose in the path's frame; None = the path's own.
    """
    turned, place_m = path.at(moments)
    known_turned, known_m = recorded.at(recorded_time_s)
    ahead = (turned if mount is None else turned @ mount[:3, :3])[:, :, 0]
    apart_m, alike = np.linalg.norm(place_m[:, None] - known_m[None], axis=2), ahead @ known_turned[:, :, 0].T
    nearest, same_way_m = apart_m.argmin(axis=1), np.where(alike > _SAME_WAY, apart_m, np.inf)
    looks_back = np.take_along_axis(alike, nearest[:, None], axis=1)[:, 0] < -_SAME_WAY
    looks_back &= same_way_m.min(axis=1) <= apart_m.min(axis=1) + _BESIDE_M
    return np.asarray(recorded_time_s[np.where(looks_back, same_way_m.argmin(axis=1), nearest)])


def plan_sweeps(
    view: ViewPlan,
    recorded_table: LaserTable,
    sensor: str | SensorEntry | None,
    *,
    has_footprint: bool = False,
) -> SweepPlan:
    """The sweeps of a view by a known sensor's name, one of one's own, or None, that of the drive.

    `has_footprint`: its beams have the width of its table.

    Raises:
        DataError: Beams are to have a width, and that of the recording sensor is not known.
    """
    is_recorded = sensor is None or sensor == recorded_table.name
    table = recorded_table if is_recorded else table_of(sensor, recorded_table)
    if has_footprint and table.divergence_mrad == 0.0:
        raise DataError(
            f"view {view.name}: footprint: the beam width of {table.name} is not known; give it as "
            "`divergence_mrad` of a [[sensor]] of your own, or leave `footprint` out"
        )
    same = {one.name: getattr(view, one.name) for one in fields(ViewPlan)}
    period_s = None if table.rate_hz is None else 1.0 / table.rate_hz
    return SweepPlan(
        **same, table=table, is_recorded_sensor=is_recorded, period_s=period_s, has_footprint=has_footprint
    )


def table_of(sensor: str | SensorEntry | None, recorded_table: LaserTable) -> LaserTable:
    """The lasers of a view's sensor; None = those that recorded the drive."""
    if sensor is None:
        return recorded_table
    return sensor.table() if isinstance(sensor, SensorEntry) else sensor_table(sensor)


def view_path(view: ViewEntry, start_to_world: np.ndarray, scene_to_world: np.ndarray) -> Trajectory | None:
    """The path that a view's entry gives; None if it follows the recorded one.

    Poses (4, 4) in the world are the LiDAR's first recorded one, the frame `start`, and that of the scene's
    frame.
    """
    if view.is_on_recorded_path:
        return None
    if view.pose_file is not None:
        times_s = np.array(view.pose_file.time_s)
        poses = np.tile(np.eye(4), (len(times_s), 1, 1))
        poses[:, :3] = np.array(view.pose_file.poses).reshape(-1, 3, 4)
    else:
        times_s, poses = _smooth(view)
    if view.path_in == "start":
        poses = start_to_world @ poses
    return Trajectory(*_prolonged(times_s, poses), scene_to_world)


def _smooth(view: ViewEntry) -> tuple[np.ndarray, np.ndarray]:
    """Times (k,) and poses (k, 4, 4) of a curve through the waypoints, without kinks in place or rotation."""
    given_s = np.array([point.time_s for point in view.waypoints], np.float64)
    poses = np.stack([
        pose_of_angles(point.position_m, point.yaw_deg, point.pitch_deg, point.roll_deg)
        for point in view.waypoints
    ])  # fmt: skip
    if len(given_s) == 1:
        return given_s, poses
    count = min(_MOST_KNOTS, max(2, int(np.ceil((given_s[-1] - given_s[0]) / _STEP_S)) + 1))
    times_s = np.linspace(given_s[0], given_s[-1], count)
    place_m = CubicSpline(given_s, poses[:, :3, 3], bc_type="natural")(times_s)
    turned = RotationSpline(given_s, Rotation.from_matrix(poses[:, :3, :3]))(times_s).as_matrix()
    return times_s, pose_from_parts(turned, place_m)


def _prolonged(times_s: np.ndarray, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The path with both ends moved on by their own motion for `_SPARE_S`; a single pose holds for ever."""
    if len(times_s) == 1:
        return times_s, poses
    ends = []
    for first, second in ((0, 1), (-1, -2)):
        twist = log_se3(
            invert_pose(poses[first : first + 1 or None][:1]) @ poses[second : second + 1 or None][:1]
        )
        share = -_SPARE_S / abs(times_s[second] - times_s[first])
        ends.append(poses[first] @ exp_se3(share * twist)[0])
    known_s = np.concatenate([[times_s[0] - _SPARE_S], times_s, [times_s[-1] + _SPARE_S]])
    return known_s, np.concatenate([ends[0][None], poses, ends[1][None]])
