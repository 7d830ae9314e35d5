"""The rays of one simulated sweep: every laser, every firing, each at its own time."""

from dataclasses import dataclass

import numpy as np

from nvsf_core.sensors.beam_table import corrected_rays, firing_grid, sensor_rays
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
    azimuth = azimuth[lasers].reshape(-1)
    laser = np.repeat(lasers.astype(np.int64), firings)
    fraction = np.tile(fraction, len(lasers))
    recorded_origin, recorded_direction = sensor_rays(table, azimuth, laser)
    recorded_origin = recorded_origin + table.range_bias_m[laser, None] * recorded_direction
    origin, direction = corrected_rays(table, azimuth, laser)
    if mount is not None:
        origin = origin @ mount[:3, :3].T + mount[:3, 3]
        direction = direction @ mount[:3, :3].T
    rotation, position = trajectory.at(time_s + fraction * period_s)
    return SweepRays(
        shape=(len(lasers), firings),
        laser=laser,
        azimuth_rad=azimuth,
        fraction=fraction,
        recorded_origin_m=recorded_origin,
        recorded_direction=recorded_direction,
        origin_m=(np.einsum("nij,nj->ni", rotation, origin) + position).astype(np.float32),
        direction=np.einsum("nij,nj->ni", rotation, direction).astype(np.float32),
    )
