"""The rays of one sweep, and the scan that they become: as a driver records it, or sampled at random."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from nvsf_core.errors import DataError
from nvsf_core.evidence.raydrop.stationary_scans import FiredRays, look_up_stationary
from nvsf_core.evidence.scene_evidence import SceneEvidence
from nvsf_core.kernels.moved_rays import move_sweep
from nvsf_core.recording.drive import LidarRecording
from nvsf_core.rendering.rendered import RenderedRays
from nvsf_core.sensors.beam_table import firing_grid, sensor_rays
from nvsf_core.sensors.linear_pano import LinearPano
from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.sensors.tables import LaserTable
from nvsf_core.simulation.raydrop import rays_return, sample_returns

_TYPICAL_OWN_RANGE_M = 2.0
"""Where a laser's ray is taken to meet the own vehicle when its azimuth is looked up."""


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


def measured_when_stationary(
    rendered: RenderedRays,
    laser: np.ndarray,
    fraction: np.ndarray,
    lidar: LidarRecording,
    instant_s: float,
    *,
    leave_out: int | None = None,
) -> RenderedRays:
    """Let rays (laser, fraction: (r,)) of the recording sensor's sweep that were fired before say so.

    The same `rendered` where the sensor never stood or crawled; the training scan `leave_out` is silent.
    """
    evidence, sweeps = lidar.evidence, lidar.sweeps
    if evidence.stationary is None:
        return rendered
    rays = FiredRays(laser, fraction, rendered.range_m, rendered.hit, rendered.intensity)
    return RenderedRays(
        *look_up_stationary(
            evidence.stationary, evidence.prior, rays, instant_s, sweeps.trajectory, sweeps.period_s,
            leave_out=leave_out,
        )
    )  # fmt: skip


def by_lasers(
    rendered: RenderedRays, laser: np.ndarray, table: LaserTable, *, as_recorded: bool
) -> RenderedRays:
    """Answers in the terms of a stored scan: intensities with their laser's gain, ranges without its bias.

    Args:
        rendered: Of r rays.
        laser: (r,) of the table; -1 = unknown, which has neither.
        table: Gains and biases.
        as_recorded: Whether the answers hold both already, as `SceneModel` says: then the bias is taken off.
            Else they hold neither, and the gain is applied.
    """
    known = laser >= 0
    if as_recorded:
        bias_m = np.where(known, table.range_bias_m[laser], 0.0)
        return replace(rendered, range_m=(rendered.range_m - bias_m).astype(np.float32))
    gain = np.where(known, table.intensity_gain[laser], 1.0)
    return replace(rendered, intensity=np.clip(rendered.intensity * gain, 0.0, 1.0).astype(np.float32))


def put_back_own_vehicle(rendered: RenderedRays, rays: SweepRays, evidence: SceneEvidence) -> RenderedRays:
    """Let rays that met the recording car in most training scans meet it again."""
    cells = evidence.own_range_m.shape[1]
    # Most lasers look over the car: theirs are not asked.
    asked = np.flatnonzero(evidence.own_range_m.max(axis=1)[rays.laser] > 0)
    laser = rays.laser[asked]
    origin, direction = rays.recorded_origin_m[asked], rays.recorded_direction[asked]
    # The car was learned by azimuth and distance seen from the sensor's centre, not from the laser.
    nearby = origin + direction * _TYPICAL_OWN_RANGE_M
    azimuth = np.arctan2(nearby[:, 1], nearby[:, 0]) % (2 * np.pi)
    cell = np.floor(azimuth / (2 * np.pi) * cells).astype(np.int64) % cells
    own_m = evidence.own_range_m[laser, cell]
    along = np.einsum("ni,ni->n", origin, direction)
    inside = along**2 - np.einsum("ni,ni->n", origin, origin) + own_m.astype(np.float64) ** 2
    is_own = (own_m > 0) & (inside > 0)
    met = asked[is_own]
    range_m, hit, intensity = (
        column.astype(np.float32) for column in (rendered.range_m, rendered.hit, rendered.intensity)
    )
    range_m[met] = np.sqrt(inside[is_own]) - along[is_own]
    hit[met] = 1.0
    intensity[met] = evidence.own_intensity[laser[is_own], cell[is_own]]
    return RenderedRays(range_m=range_m, hit=hit, intensity=intensity)


@dataclass(frozen=True, slots=True, eq=False)
class RenderedSweep:
    """r answered rays of a turn, in the sensor's own frame at each firing."""

    rays: SweepRays
    rendered: RenderedRays
    is_known: np.ndarray
    """(r,) bool: the ray has an answer at all."""
    point_m: np.ndarray
    """(r, 3) float64; without an answer where the ray starts."""
    distance_m: np.ndarray
    """(r,) float64 of the point from the sensor's centre."""
    azimuth_rad: np.ndarray
    """(r,) float64 of the point, in (-pi, pi]."""
    elevation_rad: np.ndarray
    """(r,) float64 of the point, from the sensor's centre."""

    @staticmethod
    def of(rays: SweepRays, rendered: RenderedRays) -> "RenderedSweep":
        """Points and angles of all rays, computed once."""
        known = np.isfinite(rendered.range_m)
        range_m = np.where(known, rendered.range_m, 0.0)
        point = rays.recorded_origin_m + rays.recorded_direction * range_m[:, None]
        x, y, z = np.ascontiguousarray(point.T)
        level_m2 = x * x + y * y
        elevation = np.arctan2(z, np.sqrt(level_m2))
        return RenderedSweep(
            rays, rendered, known, point, np.sqrt(level_m2 + z * z), np.arctan2(y, x), elevation
        )

    def scan(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points (m, 3) float32, intensity (m,) float32, laser (m,) int16 of what returns.

        Laser by laser from the top, azimuth ascending in [0, 360) degrees within it.
        """
        returned = np.flatnonzero(rays_return(self.rendered.hit) & self.is_known)
        azimuth = self.azimuth_rad[returned]
        azimuth = np.where(azimuth < 0.0, azimuth + 2.0 * np.pi, azimuth)
        # Rays lie laser by laser: each sorted by itself takes a sixth of the time.
        starts = np.flatnonzero(np.diff(self.rays.laser[returned])) + 1
        orders = [np.argsort(part, kind="stable") for part in np.split(azimuth, starts)]
        order = np.concatenate([own + first for own, first in zip(orders, [0, *starts], strict=True)])
        taken = returned[order]
        return (
            self.point_m[taken].astype(np.float32),
            np.clip(self.rendered.intensity[taken], 0, 1).astype(np.float32),
            self.rays.laser[taken].astype(np.int16),
        )

    def grid(self) -> dict[str, np.ndarray]:
        """By laser and firing (l, f) float32: range and angles from the sensor's centre; 0 = no answer."""
        known = self.is_known
        columns = {
            "grid_range_m": np.where(known, self.distance_m, 0.0),
            "grid_hit": np.where(known, self.rendered.hit, 0.0),
            "grid_intensity": np.clip(self.rendered.intensity, 0.0, 1.0),
            "grid_azimuth_rad": self.azimuth_rad,
            "grid_elevation_rad": self.elevation_rad,
        }
        return {name: column.reshape(self.rays.shape).astype(np.float32) for name, column in columns.items()}

    def pano_hit(self, pano: LinearPano) -> np.ndarray:
        """(H, W) float32 probability that any ray of a cell returned: 1 - prod(1 - p) over its rays."""
        row, column, kept = pano.cells_towards(self.azimuth_rad, self.elevation_rad)
        kept &= self.is_known & (self.distance_m > 0.0) & (self.distance_m < pano.max_range_m)
        missed = np.log1p(-np.clip(self.rendered.hit[kept].astype(np.float64), 0.0, 1.0 - 1e-7))
        cell = row[kept] * pano.width + column[kept]
        total = np.bincount(cell, weights=missed, minlength=pano.height * pano.width)
        return -np.expm1(total).reshape(pano.height, pano.width).astype(np.float32)


RANGE_NOISE_M = 0.015
"""Standard deviation of the range noise; an HDL-64E's maker states below 2 cm (one sigma)."""
GRID_ARRAYS = ("grid_range_m", "grid_hit", "grid_intensity", "grid_azimuth_rad", "grid_elevation_rad")
"""Arrays of a rendered sweep that a scan is sampled from, each (lasers, firings)."""


def sample_scan(
    grid: Mapping[str, np.ndarray], generator: np.random.Generator, range_noise_m: float = RANGE_NOISE_M
) -> np.ndarray:
    """Sample one scan of a rendered sweep.

    Args:
        grid: `grid_*` of one sweep, each (lasers, firings): range (metres, inf = nothing there), hit
            probability, intensity 0..1, azimuth and elevation in the sensor's frame at firing time.
        generator: What is random comes from here.
        range_noise_m: Standard deviation of the range.

    Returns:
        (N, 4) float32 x, y, z, intensity: laser by laser from the top, azimuth ascending in [0, 360) degrees.

    Raises:
        DataError: An array of the grid holds NaN; as a hit it would silently be a drop.
    """
    for name in GRID_ARRAYS:
        broken = int(np.count_nonzero(np.isnan(grid[name])))
        if broken:
            raise DataError(
                f"sample_scan: {broken} of {grid[name].size} values of {name} are NaN; the model that "
                "rendered them has diverged: train it again"
            )
    range_m = grid["grid_range_m"].astype(np.float64)
    kept = sample_returns(grid["grid_hit"], generator)
    noise_m = generator.normal(0.0, range_noise_m, range_m.shape)
    kept &= np.isfinite(range_m) & (range_m > 0.0)
    noisy_m = np.maximum(np.where(kept, range_m, 1.0) + noise_m, 0.01)
    azimuth, elevation = (grid[f"grid_{name}_rad"].astype(np.float64) for name in ("azimuth", "elevation"))
    level_m = noisy_m * np.cos(elevation)
    scan = np.stack(
        [
            level_m * np.cos(azimuth),
            level_m * np.sin(azimuth),
            noisy_m * np.sin(elevation),
            np.clip(grid["grid_intensity"], 0.0, 1.0),
        ],
        axis=-1,
    ).astype(np.float32)
    order = np.argsort(np.mod(azimuth, 2.0 * np.pi), axis=1, kind="stable")
    sampled: np.ndarray = np.take_along_axis(scan, order[..., None], 1)[np.take_along_axis(kept, order, 1)]
    return sampled


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
