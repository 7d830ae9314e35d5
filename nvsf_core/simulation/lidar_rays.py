"""The rays of one simulated sweep: every laser, every firing, each at its own time."""

from dataclasses import dataclass

import numpy as np

from nvsf_core.kernels.moved_rays import move_sweep
from nvsf_core.sensors.beam_table import firing_grid, sensor_rays
from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.sensors.tables import LaserTable


@dataclass(frozen=True, slots=True)
class SweepRays:
    """l lasers x f firings, flat, laser by laser from the top."""

    shape: tuple[int, int]
    """(l, f)."""
    laser: np.ndarray
    """(r,) int: row of the sensor's table."""
    azimuth_rad: np.ndarray
    """(r,) encoder's angle in (-pi, pi]."""
    fraction: np.ndarray
    """(r,) sweeps after the pose's instant."""
    recorded_origin_m: np.ndarray
    """(r, 3) in the sensor's frame, as a file would have it: from here, the range to the surface along the
    ray ends where the laser, with its own bias, records the return."""
    recorded_direction: np.ndarray
    """(r, 3) likewise."""
    origin_m: np.ndarray
    """(r, 3) float32 scene-local."""
    direction: np.ndarray
    """(r, 3) float32 scene-local, elevation corrected."""


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
    """Rays of the sweep whose pose belongs to `time_s`.

    Args:
        table: The sensor that is simulated.
        lasers: (l,) rows of the table to fire, from the top.
        firings: Firings of one turn.
        trajectory: Where the recording sensor was.
        time_s: The instant of the sweep's pose.
        period_s: Duration of a turn.
        mount: (4, 4) pose of the simulated sensor in the recording sensor's frame; None = the same place.
        phase: Where the turn starts against its firings, 0..1 of one.
    """
    azimuth, fraction = firing_grid(table, firings, phase)
    # All lasers fire together: the sensor's pose is looked up once a firing, not once a ray.
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
