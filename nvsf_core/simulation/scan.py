"""The scan that the rendered rays of one sweep give: as recorded, or sampled at random."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from nvsf_core.errors import DataError
from nvsf_core.evidence.scene_evidence import SceneEvidence
from nvsf_core.evidence.stationary_scans import FiredRays, look_up_stationary
from nvsf_core.recording.drive import LidarRecording
from nvsf_core.rendering.rendered import RenderedRays
from nvsf_core.sensors.linear_pano import LinearPano
from nvsf_core.sensors.sweep import SweepRays
from nvsf_core.sensors.tables import LaserTable
from nvsf_core.simulation.raydrop import rays_return, sharpen_hits

RANGE_NOISE_M = 0.015
"""Standard deviation of the range noise; an HDL-64E's maker states below 2 cm (one sigma)."""
GRID_ARRAYS = ("grid_range_m", "grid_hit", "grid_intensity", "grid_azimuth_rad", "grid_elevation_rad")
"""Arrays (lasers, firings) of a rendered sweep that a scan is sampled from: see `sample_scan`."""
_TYPICAL_OWN_RANGE_M = 2.0
"""Range assumed for a ray that meets the own vehicle, when the azimuth of that place is computed."""
_NOISE_NEAR_M = 30.0
"""Beyond it neighbouring firings meet surfaces too far from each other."""
_NOISE_EDGE_M = 0.5
"""Larger second differences are edges."""
_NORMAL_MAD = 1.4826
"""Standard deviation of a normal distribution, in median absolute deviations."""
_FEWEST_DIFFERENCES = 100


def measured_when_stationary(
    rendered: RenderedRays,
    laser: np.ndarray,
    fraction: np.ndarray,
    lidar: LidarRecording,
    instant_s: float,
    *,
    leave_out: int | None = None,
) -> RenderedRays:
    """Use what stationary training scans measured along the same rays; no change if there are no such scans.

    Args:
        rendered: Of r rays of a sweep of the recording sensor.
        laser: (r,) row of the sensor's table.
        fraction: (r,) -azimuth / 2 pi of the rays' firings, -0.5..0.5.
        lidar: The recording.
        instant_s: Time of the sweep's pose.
        leave_out: Index of a training scan that is not used.
    """
    evidence, sweeps = lidar.evidence, lidar.sweeps
    if evidence.stationary is None:
        return rendered
    clock = sweeps.clock_near(instant_s)
    rays = FiredRays(laser, fraction, rendered.range_m, rendered.hit, rendered.intensity, clock)
    return RenderedRays(
        *look_up_stationary(
            evidence.stationary, evidence.prior, rays, instant_s, sweeps.trajectory, sweeps.period_s,
            leave_out=leave_out, clocks=sweeps.training_clocks,
        )
    )  # fmt: skip


def by_lasers(
    rendered: RenderedRays, laser: np.ndarray, table: LaserTable, *, as_recorded: bool
) -> RenderedRays:
    """Convert to the convention of stored scans: intensities with the laser's gain, ranges without its bias.

    Of r rays by rows (r,) of the table, -1 = unknown: neither gain nor bias. `as_recorded`: they have both,
    see `SceneModel`, and the bias is subtracted. Else they have neither, and the gain is applied.
    """
    known = laser >= 0
    if as_recorded:
        bias_m = np.where(known, table.range_bias_m[laser], 0.0)
        return replace(rendered, range_m=(rendered.range_m - bias_m).astype(np.float32))
    gain = np.where(known, table.intensity_gain[laser], 1.0)
    return replace(rendered, intensity=np.clip(rendered.intensity * gain, 0.0, 1.0).astype(np.float32))


def put_back_own_vehicle(rendered: RenderedRays, rays: SweepRays, evidence: SceneEvidence) -> RenderedRays:
    """Add returns from the own vehicle for rays, of all r of a sweep, that met it in most training scans."""
    cells = evidence.own_range_m.shape[1]
    # Most lasers look over the car: only the rays of the others are computed.
    low = np.flatnonzero(evidence.own_range_m.max(axis=1)[rays.laser] > 0)
    laser = rays.laser[low]
    origin, direction = rays.recorded_origin_m[low], rays.recorded_direction[low]
    # The car is stored by azimuth and distance from the sensor's centre, not from the laser.
    nearby = origin + direction * _TYPICAL_OWN_RANGE_M
    azimuth = np.arctan2(nearby[:, 1], nearby[:, 0]) % (2 * np.pi)
    cell = np.floor(azimuth / (2 * np.pi) * cells).astype(np.int64) % cells
    own_m = evidence.own_range_m[laser, cell]
    along = np.einsum("ni,ni->n", origin, direction)
    inside = along**2 - np.einsum("ni,ni->n", origin, origin) + own_m.astype(np.float64) ** 2
    is_own = (own_m > 0) & (inside > 0)
    met = low[is_own]
    range_m, hit, intensity = (
        column.astype(np.float32) for column in (rendered.range_m, rendered.hit, rendered.intensity)
    )
    range_m[met] = np.sqrt(inside[is_own]) - along[is_own]
    hit[met] = 1.0
    intensity[met] = evidence.own_intensity[laser[is_own], cell[is_own]]
    return RenderedRays(range_m=range_m, hit=hit, intensity=intensity)


def returns_of_sweep(rays: SweepRays, rendered: RenderedRays) -> np.ndarray:
    """Which rays (r,) bool of a sweep return, by `rays_return`; none does that meets no surface."""
    hit = np.where(np.isfinite(rendered.range_m), rendered.hit, 0.0)
    return rays_return(hit.reshape(rays.shape)).reshape(-1)


@dataclass(frozen=True, slots=True, eq=False)
class RenderedSweep:
    """The r rendered rays of a sweep as points in the sensor's frame at firing time."""

    rays: SweepRays
    rendered: RenderedRays
    is_known: np.ndarray
    """(r,) bool: the ray meets a surface."""
    point_m: np.ndarray
    """(r, 3) float64, metres; the ray's origin where it meets no surface."""
    distance_m: np.ndarray
    """(r,) float64, of the point from the sensor's centre."""
    azimuth_rad: np.ndarray
    """(r,) float64, of the point, in (-pi, pi]."""
    elevation_rad: np.ndarray
    """(r,) float64, of the point, seen from the sensor's centre."""

    @staticmethod
    def of(rays: SweepRays, rendered: RenderedRays) -> "RenderedSweep":
        """Compute points and angles of all rays."""
        known = np.isfinite(rendered.range_m)
        range_m = np.where(known, rendered.range_m, 0.0)
        point = rays.recorded_origin_m + rays.recorded_direction * range_m[:, None]
        x, y, z = np.ascontiguousarray(point.T)
        level_m2 = x * x + y * y
        elevation = np.arctan2(z, np.sqrt(level_m2))
        return RenderedSweep(
            rays, rendered, known, point, np.sqrt(level_m2 + z * z), np.arctan2(y, x), elevation
        )

    def returns(self) -> np.ndarray:
        """(m,) numbers of the rays that return, in a scan's order.

        Laser by laser from the top, and by azimuth ascending in [0, 360) degrees within each laser.
        """
        returned = np.flatnonzero(returns_of_sweep(self.rays, self.rendered))
        azimuth = self.azimuth_rad[returned]
        azimuth = np.where(azimuth < 0.0, azimuth + 2.0 * np.pi, azimuth)
        # Rays lie laser by laser: each sorted by itself takes a sixth of the time.
        starts = np.flatnonzero(np.diff(self.rays.laser[returned])) + 1
        orders = [np.argsort(part, kind="stable") for part in np.split(azimuth, starts)]
        order = np.concatenate([own + first for own, first in zip(orders, [0, *starts], strict=True)])
        return np.asarray(returned[order])

    def scan(self, returns: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The recorded scan: points (m, 3) float32, intensity (m,) float32, laser (m,) int16 of the returns.

        Points are in the sensor's frame at firing time, in the order of `self.returns()`, which is computed
        unless given.
        """
        taken = self.returns() if returns is None else returns
        return (
            self.point_m[taken].astype(np.float32),
            np.clip(self.rendered.intensity[taken], 0, 1).astype(np.float32),
            self.rays.laser[taken].astype(np.int16),
        )

    def grid(self) -> dict[str, np.ndarray]:
        """Arrays (l, f) float32 of `GRID_ARRAYS`; range and hit are 0 where a ray meets no surface."""
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
        """Probability (H, W) float32, 1 - prod(1 - p), that any of the rays of a pano's pixel returns."""
        row, column, kept = pano.cells_towards(self.azimuth_rad, self.elevation_rad)
        kept &= self.is_known & (self.distance_m > 0.0) & (self.distance_m < pano.max_range_m)
        missed = np.log1p(-np.clip(self.rendered.hit[kept].astype(np.float64), 0.0, 1.0 - 1e-7))
        cell = row[kept] * pano.width + column[kept]
        total = np.bincount(cell, weights=missed, minlength=pano.height * pano.width)
        return -np.expm1(total).reshape(pano.height, pano.width).astype(np.float32)


def sample_scan(
    grid: Mapping[str, np.ndarray],
    generator: np.random.Generator,
    range_noise_m: float = RANGE_NOISE_M,
    *,
    by_threshold: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Sample one scan of a rendered sweep: which rays return, and the noise of their ranges.

    Args:
        grid: `GRID_ARRAYS` of one sweep, each (lasers, firings): range from the sensor's centre (metres, 0 or
            inf = no surface), hit probability, intensity 0..1, azimuth and elevation in the sensor's frame at
            firing time.
        generator: Source of all randomness.
        range_noise_m: Standard deviation of the range.
        by_threshold: Those rays return that `rays_return` names, and nothing is sampled but noise.

    Returns:
        (N, 4) float32 x, y, z, intensity: laser by laser from the top, azimuth ascending in [0, 360) degrees;
        and the number (N,) of each return's ray in the flat grid.

    Raises:
        DataError: An array of the grid holds NaN, which would count as a dropped ray.
    """
    for name in GRID_ARRAYS:
        broken = int(np.count_nonzero(np.isnan(grid[name])))
        if broken:
            raise DataError(
                f"sample_scan: {broken} of {grid[name].size} values of {name} are NaN; the model that "
                "rendered them has diverged: train it again"
            )
    range_m = grid["grid_range_m"].astype(np.float64)
    hit = grid["grid_hit"]
    kept = rays_return(hit) if by_threshold else generator.random(hit.shape) < sharpen_hits(hit)
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
    ray = (order + order.shape[1] * np.arange(len(order))[:, None])[np.take_along_axis(kept, order, 1)]
    return scan.reshape(-1, 4)[ray], ray


def measured_range_noise_m(
    range_m: np.ndarray, laser: np.ndarray, firing: np.ndarray, offsets: np.ndarray
) -> float:
    """Standard deviation of the recorded range noise, metres; NaN where too few firings follow each other.

    Measured without knowing the surfaces. Three firings of a laser that follow each other meet nearly one
    plane: of their ranges (N,) the second difference r1 - 2 r2 + r3 is noise alone, with six times its
    variance. Edges and noise of other kinds are left out by the median. Lasers and firings (N,) are -1 where
    unknown; scan k's returns are offsets[k] .. offsets[k + 1] - 1.
    """
    scan = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    known = np.flatnonzero((laser >= 0) & (firing >= 0) & (range_m > 0.0) & (range_m < _NOISE_NEAR_M))
    order = known[np.lexsort((firing[known], laser[known], scan[known]))]
    first, last = order[:-2], order[2:]
    beside = (scan[first] == scan[last]) & (laser[first] == laser[last])
    beside &= firing[last].astype(np.int64) - firing[first] == 2
    bend_m = np.abs(range_m[first] - 2.0 * range_m[order[1:-1]] + range_m[last])[beside]
    bend_m = bend_m[bend_m < _NOISE_EDGE_M]
    if len(bend_m) < _FEWEST_DIFFERENCES:
        return float("nan")
    return float(_NORMAL_MAD * np.median(bend_m) / np.sqrt(6.0))
