"""The rays that a sensor fires in one sweep: when, from where and where to."""

from dataclasses import dataclass

import numpy as np

from nvsf_core.kernels.moved_rays import move_sweep
from nvsf_core.sensors.beam_table import firing_grid, sensor_rays
from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.sensors.tables import LaserTable


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
    """(r,) time after the pose's instant, in sweeps, -0.5..0.5."""
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
    """
    azimuth, fraction = firing_grid(table, firings, phase)
    # All lasers fire together: the sensor's pose is computed once a firing, not once a ray.
    rotation, position = trajectory.at(time_s + fraction * period_s)
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
        recorded_origin_m=fired_origin + table.range_bias_m[laser, None] * recorded_direction,
        recorded_direction=recorded_direction,
        origin_m=origin,
        direction=direction,
    )
