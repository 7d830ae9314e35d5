"""Ego-motion: when and from where each ray of a rotating sensor was fired.

Unless its clock says otherwise, a sensor rotates clockwise and is cut behind; a frame's pose is its pose when
the laser faces forward. A return at azimuth a in (-pi, pi] is measured s = -a / 2 pi of a sweep later, s in
[-0.5, 0.5). Between two poses the sensor moves
at a constant twist (rotation and translation together).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from nvsf_core.errors import DataError, ShapeError
from nvsf_core.geometry.se3 import exp_se3, invert_pose, log_se3, poses_in
from nvsf_core.kernels.moved_rays import move_sweep
from nvsf_core.sensors.beam_table import (
    encoder_angle,
    firing_grid,
    recorded_ray_of_points,
    sensor_rays,
    turn_up,
    wrap_angle,
)
from nvsf_core.sensors.sweep_clock import SweepClock, sweep_duration_s
from nvsf_core.sensors.tables import LaserTable

_LEAST_SPARE_S = 0.1
"""Half a sweep at 5 Hz, the slowest there is: rendered scans may be nearer to each other than half of one."""


def sweep_fraction(azimuth_rad: np.ndarray) -> np.ndarray:
    """-a / 2 pi of azimuths (...), in [-0.5, 0.5): where in a sweep that is cut behind they are measured."""
    return -wrap_angle(azimuth_rad) / (2.0 * np.pi)


def sweep_by_points_s(points_m: np.ndarray, offset_s: np.ndarray | None, step_s: float) -> float | None:
    """Duration of a sweep by its points' times; None where there are none, or they do not follow the azimuth.

    Args:
        points_m: (N, 3) or more columns: x, y, z in the sensor's frame, metres.
        offset_s: (N,) seconds after the frame's time; None = not recorded.
        step_s: From frame to frame, above 0.
    """
    if offset_s is None:
        return None
    azimuth_rad = np.arctan2(points_m[:, 1].astype(np.float64), points_m[:, 0])
    return sweep_duration_s(sweep_fraction(azimuth_rad), offset_s, step_s)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses of the sensor at any time of a drive."""

    times_s: np.ndarray
    """(n,) float64, ascending: instants of the poses."""
    lidar_to_world: np.ndarray
    """(n, 4, 4) float64 poses, metres."""
    scene_to_world: np.ndarray
    """(4, 4) float64, pose of the scene's frame in the world."""
    _local: np.ndarray = field(init=False, repr=False)
    _twists: np.ndarray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Check the poses, move them into the scene, and compute the twist from each to the next.

        Raises:
            ShapeError: Times, poses and frame do not fit one another.
            DataError: Times do not ascend, or a pose is not finite.
        """
        times_s = np.asarray(self.times_s, np.float64)
        poses = np.asarray(self.lidar_to_world, np.float64)
        scene_to_world = np.asarray(self.scene_to_world, np.float64)
        if len(times_s) == 0 or poses.shape != (len(times_s), 4, 4) or scene_to_world.shape != (4, 4):
            raise ShapeError(
                f"expected times (n,), poses (n, 4, 4), a frame (4, 4) with n >= 1, found {times_s.shape}, "
                f"{poses.shape}, {scene_to_world.shape}"
            )
        if not (np.diff(times_s) > 0.0).all():
            where = int(np.argmin(np.diff(times_s)))
            raise DataError(
                f"expected ascending times, found {times_s[where]} s before {times_s[where + 1]} s at poses "
                f"{where} and {where + 1}; correct the timestamps or remove them"
            )
        if not np.isfinite(poses).all():
            raise DataError("expected finite poses, found NaN or infinity; leave invalid frames out")
        local = poses_in(scene_to_world, poses)
        twists = log_se3(invert_pose(local[:-1]) @ local[1:]) if len(local) > 1 else np.zeros((0, 6))
        object.__setattr__(self, "times_s", times_s)
        object.__setattr__(self, "scene_to_world", scene_to_world)
        object.__setattr__(self, "_local", local)
        object.__setattr__(self, "_twists", twists)

    def at(self, time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rotation (N, 3, 3) and scene-local position (N, 3) of the sensor at times (N,), float64.

        Before the first and after the last pose the motion continues unchanged for one interval, or half of
        the longest sweep; a gap in the frames is interpolated. With a single pose the sensor does not move.

        Raises:
            DataError: A time lies further outside the poses, or is not finite.
        """
        time_s = np.asarray(time_s, np.float64)
        if len(self.times_s) == 1:
            pose = np.repeat(self._local, len(time_s), axis=0)
            return pose[:, :3, :3], pose[:, :3, 3]
        self._check_within(time_s)
        # All lasers fire together: a scan has 120,000 returns but only some 2,000 times.
        moments_s, inverse = np.unique(time_s, return_inverse=True)
        before = np.searchsorted(self.times_s, moments_s, side="right") - 1
        interval = np.clip(before, 0, len(self.times_s) - 2)
        length_s = self.times_s[interval + 1] - self.times_s[interval]
        share = (moments_s - self.times_s[interval]) / length_s
        pose = self._local[interval] @ exp_se3(share[:, None] * self._twists[interval])
        return pose[inverse, :3, :3], pose[inverse, :3, 3]

    def _check_within(self, time_s: np.ndarray) -> None:
        spare_s = max(float(np.median(np.diff(self.times_s))), _LEAST_SPARE_S) * (1.0 + 1e-6)
        first_s, last_s = self.times_s[0] - spare_s, self.times_s[-1] + spare_s
        outside = ~((time_s >= first_s) & (time_s <= last_s))
        if outside.any():
            raise DataError(
                f"expected times within {first_s:.4f} .. {last_s:.4f} s, found {time_s[outside][0]} s; "
                "ask for times at most one frame outside the recorded poses"
            )

    def move_rays(
        self, origin_s: np.ndarray, direction_s: np.ndarray, time_s: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Scene-local origins and directions (N, 3) float64 of rays in the sensor's frame at times (N,)."""
        rotation, position_m = self.at(time_s)
        origin_m = np.einsum("nij,nj->ni", rotation, origin_s) + position_m
        return origin_m, np.einsum("nij,nj->ni", rotation, direction_s)


def trajectory_of(frames: Sequence[Mapping[str, Any]], scene_to_world: np.ndarray) -> Trajectory:
    """Trajectory of the LiDAR frame, from the frames that have a pose; `scene_to_world` is (4, 4).

    Frames have `pose_valid`, `time_s` and `lidar_to_world`, a 4 x 4 matrix as 16 numbers.
    """
    posed = [frame for frame in frames if frame["pose_valid"]]
    return Trajectory(
        np.array([frame["time_s"] for frame in posed]),
        np.array([frame["lidar_to_world"] for frame in posed]).reshape(-1, 4, 4),
        scene_to_world,
    )


def compensate(
    table: LaserTable,
    points_m: np.ndarray,
    laser: np.ndarray,
    time_s: np.ndarray,
    trajectory: Trajectory,
    *,
    elevation_correction_rad: float | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ego-motion compensation: one scan's returns as rays, each from where its laser was at its own time.

    Args:
        table: The sensor.
        points_m: (N, 3) metres as recorded, in the moving sensor's frame.
        laser: (N,) int from the top; -1 = unknown, such rays start at the sensor's centre.
        time_s: (N,) instant of each return. The pose's instant for all of them means no compensation, as in
            the papers.
        trajectory: The sensor's poses.
        elevation_correction_rad: Angle by which rays are turned up; None = the table's.

    Returns:
        origin_m (N, 3), unit direction (N, 3), range_m (N,): scene-local, metres, float64.
    """
    angle_rad = elevation_correction_rad
    if angle_rad is None:
        angle_rad = table.elevation_correction_rad
    origin_s, direction_s, range_m = recorded_ray_of_points(table, points_m, laser)
    origin_s, direction_s = turn_up(origin_s, direction_s, encoder_angle(table, points_m, laser), angle_rad)
    origin_m, direction = trajectory.move_rays(origin_s, direction_s, time_s)
    return origin_m, direction, range_m


@dataclass(frozen=True, slots=True)
class SweepRays:
    """The r = l x f rays of a sweep of l lasers and f firings, flat, laser by laser from the top."""

    shape: tuple[int, int]
    """(l, f)."""
    laser: np.ndarray
    """(r,) int: row of the sensor's table."""
    azimuth_rad: np.ndarray
    """(r,) encoder's angle in (-pi, pi]."""
    fraction: np.ndarray
    """(r,) -azimuth / 2 pi of the firing, -0.5..0.5."""
    elapsed: np.ndarray
    """(r,) time after the pose's instant, in sweeps."""
    recorded_origin_m: np.ndarray
    """(r, 3) metres, sensor's frame at firing time, as in files. Moved along the ray by the laser's range
    bias: origin + true range * direction is the recorded point."""
    recorded_direction: np.ndarray
    """(r, 3) unit, sensor's frame at firing time, as in files: without the elevation correction."""
    origin_m: np.ndarray
    """(r, 3) float32, scene-local, metres."""
    direction: np.ndarray
    """(r, 3) float32, unit, scene-local axes, with the elevation correction."""


# Wide: sensor, path, instant and mounting are independent of each other.
def sweep_rays(
    table: LaserTable,
    lasers: np.ndarray,
    firings: int,
    trajectory: Trajectory,
    time_s: float,
    period_s: float,
    *,
    mount: np.ndarray | None = None,
    phase: float = 0.5,
    clock: SweepClock | None = None,
) -> SweepRays:
    """All rays of one sweep.

    Args:
        table: The simulated sensor.
        lasers: (l,) rows of the table that are fired, from the top.
        firings: Firings of one sweep.
        trajectory: Path of the recording sensor.
        time_s: Instant of the sweep's pose, seconds since the first frame.
        period_s: Duration of a sweep.
        mount: (4, 4) pose of the simulated sensor in the recording sensor's frame; None = the same pose.
        phase: Offset of the firings' azimuths, 0..1 of the step from firing to firing.
        clock: When in the sweep each azimuth is measured; None = clockwise, cut behind.
    """
    azimuth, fraction = firing_grid(table, firings, phase)
    elapsed = fraction if clock is None else clock.elapsed(fraction)
    # All lasers fire together: the sensor's pose is computed once a firing, not once a ray.
    rotation, position = trajectory.at(time_s + elapsed * period_s)
    lasers = lasers.astype(np.int64)
    azimuth = azimuth[lasers]
    fired = sensor_rays(table, azimuth, lasers[:, None])
    origin, direction = move_sweep(
        *fired, azimuth, table.elevation_correction_rad,
        np.eye(4) if mount is None else np.ascontiguousarray(mount, np.float64), rotation, position,
    )  # fmt: skip
    fired_origin, recorded_direction = (ray.reshape(-1, 3) for ray in fired)
    laser = np.repeat(lasers, firings)
    return SweepRays(
        shape=(len(lasers), firings),
        laser=laser,
        azimuth_rad=azimuth.reshape(-1),
        fraction=np.tile(fraction, len(lasers)),
        elapsed=np.tile(elapsed, len(lasers)),
        recorded_origin_m=fired_origin + table.range_bias_m[laser, None] * recorded_direction,
        recorded_direction=recorded_direction,
        origin_m=origin,
        direction=direction,
    )
