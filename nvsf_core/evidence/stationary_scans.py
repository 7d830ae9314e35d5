"""Looks rays up in stationary scans: where the sensor stood or crawled, it fired each ray several times.

Range, hit probability and intensity of such a ray are combined from the nearest training scans, weighted by
their distance in time, and from the surfels, which count as one more scan. Where a car drives by the scans
disagree, and those nearest in time decide. Or they are copied from the scan nearest in time, in scenes where
left-out scans show that this is better.
"""

from dataclasses import dataclass

import numpy as np

from nvsf_core.evidence.drop_prior import DropPrior, FiredCells
from nvsf_core.geometry.se3 import log_so3
from nvsf_core.sensors.sweep import Trajectory

MOST_APART_M = 0.3
"""Scans farther than this from every other pose are not kept: no ray's footprint is wider."""
NEAREST_SCANS = 12
"""Most scans that are looked up."""
_NOISE_M = 0.02
"""Noise of a measured range: a sensor that moved less than this is taken as in the same place."""
_AGREE_M, _AGREE_PER_RANGE = 0.1, 0.005
"""Two ranges of one surface differ by less: metres, plus metres per metre of range."""
_SURFACE_WEIGHT = 1.0
"""Weight of the surfels' values: that of a scan of the frame before or after."""
_FOOTPRINT_STEPS = 1.5
"""How far a ray may be off and still count as the same, in angles from firing to firing."""
_FADE = 1.5
"""A scan k frames away has the weight k^-1.5: the two scans beside a sweep outweigh all others."""
_BESIDE_FRAMES = 1.5
"""Scans nearer to a sweep than this are beside it."""
_STILL_M = 0.02
"""Where the sensor moved less than this, a trend of the ranges is noise and is not followed."""
_SAME_INSTANT_S = 1e-6
_MOMENTS = 17
"""Instants of a sweep at which the sensor's poses are compared."""
_CHUNK_RAYS = 65536


@dataclass(frozen=True, slots=True, eq=False)
class StationaryScans:
    """Returns, by laser and firing, of m training scans recorded at nearly the same place as another."""

    scan: np.ndarray
    """(m,) int32 ascending: numbers of the training scans."""
    range_m: np.ndarray
    """(m, lasers, f) float32 metres along the laser's ray; 0 = no return."""
    intensity: np.ndarray
    """(m, lasers, f) float32."""
    is_copied: np.ndarray
    """() bool: a ray's values are those of the scan nearest in time; else they are combined."""

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Named arrays that `from_arrays` reads back."""
        return {f"at_rest_{name}": getattr(self, name) for name in self.__slots__}

    @staticmethod
    def from_arrays(arrays: dict[str, np.ndarray]) -> "StationaryScans | None":
        """Read back what `to_arrays` gave; None where the sensor never stood or crawled."""
        if "at_rest_scan" not in arrays:
            return None
        return StationaryScans(*(arrays[f"at_rest_{name}"] for name in StationaryScans.__slots__))


@dataclass(frozen=True, slots=True, eq=False)
class FiredRays:
    """r rays of one sweep of the recording sensor, with their values as rendered from surfels."""

    laser: np.ndarray
    """(r,) int, 0 on top."""
    fraction: np.ndarray
    """(r,) sweeps after the pose's instant."""
    range_m: np.ndarray
    """(r,) float32 metres, infinite where the ray meets no surface."""
    hit: np.ndarray
    """(r,) float32 probability of a return."""
    intensity: np.ndarray
    """(r,) float32."""


@dataclass(frozen=True, slots=True, eq=False)
class _Lookup:
    """Values of r rays in k scans, the scan nearest in time first."""

    range_m: np.ndarray
    """(k, r) float32 metres, 0 = no return."""
    intensity: np.ndarray
    """(k, r) float32."""
    weight: np.ndarray
    """(k, r) float32: 1 for a scan one frame away, less farther away, 0 where the sensor was elsewhere."""
    moved_m: np.ndarray
    """(k, r) float32 metres: how far the sensor was away; negative for earlier scans."""
    frames: np.ndarray
    """(k,) float64 frames from the sweep to each scan, negative before it."""


def find_stationary_scans(time_s: np.ndarray, trajectory: Trajectory) -> np.ndarray:
    """Which (m,) int64 of the training scans at `time_s` (n,) lie within 0.3 m of another frame's pose."""
    _, there = trajectory.at(trajectory.times_s)
    _, here = trajectory.at(time_s)
    apart_m = np.linalg.norm(here[:, None] - there[None], axis=-1)
    apart_m[np.abs(time_s[:, None] - trajectory.times_s[None]) < _SAME_INSTANT_S] = np.inf
    return np.flatnonzero(apart_m.min(axis=1, initial=np.inf) < MOST_APART_M)


def keep_scans(
    scan: np.ndarray,
    prior: DropPrior,
    cells: FiredCells,
    laser: np.ndarray,
    range_m: np.ndarray,
    intensity: np.ndarray,
) -> StationaryScans:
    """Put the returns of stationary scans into the grid of lasers and firings.

    Args:
        scan: (m,) int ascending, numbers of the stationary scans among the training scans.
        prior: Gives the grid.
        cells: Cells of the training scans' N returns, from `find_cells`.
        laser: (N,) int, 0 on top.
        range_m: (N,) metres along the laser's ray.
        intensity: (N,) 0..1.
    """
    number = np.full(len(prior.time_s), -1)
    number[scan] = np.arange(len(scan))
    kept = cells.is_known & (number[cells.scan] >= 0)
    cell = (number[cells.scan[kept]], laser[kept], cells.column[kept])
    shape = (len(scan), *prior.is_hit.shape[1:])
    ranges, shine = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    ranges[cell], shine[cell] = range_m[kept], intensity[kept]
    return StationaryScans(scan.astype(np.int32), ranges, shine, np.array(False))


def look_up_stationary(
    stationary: StationaryScans,
    prior: DropPrior,
    rays: FiredRays,
    instant_s: float,
    trajectory: Trajectory,
    period_s: float,
    *,
    leave_out: int | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Range (infinite = no return), hit probability and intensity (r,) float32 of a sweep's rays.

    Rays that no training scan fired from the same place keep the surfels' values, bit by bit.

    Args:
        stationary: The scans to look the rays up in.
        prior: Of the same drive.
        rays: Any number of rays of the sweep.
        instant_s: Instant of the sweep's pose.
        trajectory: All recorded poses.
        period_s: Seconds of one sweep.
        leave_out: Number of a training scan that is not used.
    """
    apart_s = np.abs(prior.time_s[stationary.scan] - instant_s)
    order = np.argsort(apart_s, kind="stable")
    order = order[stationary.scan[order] != leave_out] if leave_out is not None else order
    frame_s = float(np.median(np.diff(trajectory.times_s))) if len(trajectory.times_s) > 1 else period_s
    there = [
        (int(row), *_apart(prior.time_s[stationary.scan[row]], instant_s, trajectory, period_s))
        for row in order[:NEAREST_SCANS]
    ]
    there = [one for one in there if np.abs(one[1]).min() < MOST_APART_M]
    if not there:
        return rays.range_m, rays.hit, rays.intensity
    rendered = rays.range_m.copy(), rays.hit.copy(), rays.intensity.copy()
    for start in range(0, len(rays.laser), _CHUNK_RAYS):
        part = slice(start, start + _CHUNK_RAYS)
        some = FiredRays(*(getattr(rays, name)[part] for name in FiredRays.__slots__))
        found = _look_up(stationary, prior, some, there, instant_s, frame_s)
        rows = np.flatnonzero(found.weight.any(axis=0))
        values = (_copy if stationary.is_copied else _combine)(found, some, rows)
        for target, value in zip(rendered, values, strict=True):
            target[part][rows] = value
    return rendered


def _apart(
    scan_s: float, instant_s: float, trajectory: Trajectory, period_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """Metres (17,), negative for earlier scans, and radians (17,) between a scan's poses and a sweep's."""
    lag_s = np.linspace(-0.5, 0.5, _MOMENTS) * period_s
    turned, moved = trajectory.at(scan_s + lag_s)
    turn, place = trajectory.at(instant_s + lag_s)
    apart_m = np.linalg.norm(moved - place, axis=1)
    angle_rad = np.linalg.norm(log_so3(np.swapaxes(turn, 1, 2) @ turned), axis=1)
    return np.copysign(apart_m, scan_s - instant_s), angle_rad


def _look_up(
    stationary: StationaryScans,
    prior: DropPrior,
    rays: FiredRays,
    there: list[tuple[int, np.ndarray, np.ndarray]],
    instant_s: float,
    frame_s: float,
) -> _Lookup:
    """Values of rays in some scans; `there` holds each scan's row, offsets and angles from `_apart`."""
    moments = np.linspace(-0.5, 0.5, _MOMENTS)
    shape = (len(there), len(rays.laser))
    scan_s = np.array([prior.time_s[stationary.scan[row]] for row, _, _ in there])
    frames = (scan_s - instant_s) / frame_s
    ranges, shine, weight, moved = (np.zeros(shape, np.float32) for _ in range(4))
    found = _Lookup(ranges, shine, weight, moved, frames)
    for k, (row, moved_m, angle_rad) in enumerate(there):
        scan = int(stationary.scan[row])
        column = prior.nearest_firing(scan, rays.fraction)
        step_rad = 2.0 * np.pi / prior.firings_of(scan)
        found.range_m[k] = stationary.range_m[row, rays.laser, column]
        found.intensity[k] = stationary.intensity[row, rays.laser, column]
        found.moved_m[k] = np.interp(rays.fraction, moments, moved_m)
        reach_m = np.where(found.range_m[k] > 0, found.range_m[k], np.minimum(rays.range_m, 1e3))
        footprint_m = _NOISE_M + _FOOTPRINT_STEPS * step_rad * reach_m
        off_m = np.abs(found.moved_m[k]) + np.interp(rays.fraction, moments, angle_rad) * reach_m
        found.weight[k] = np.where(off_m < footprint_m, max(abs(frames[k]), 1.0) ** -_FADE, 0.0)
    return found


def _copy(found: _Lookup, rays: FiredRays, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """As `_combine`, from the scan nearest in time alone."""
    nearest = (found.weight[:, rows] > 0.0).argmax(axis=0)
    range_m, intensity = found.range_m[nearest, rows], found.intensity[nearest, rows]
    returned = range_m > 0.0
    # A ray without a return keeps the surface behind it, as the rays that are combined do.
    range_m = np.where(returned, range_m, rays.range_m[rows])
    intensity = np.where(returned, intensity, rays.intensity[rows])
    return range_m, returned.astype(np.float32), intensity


def _combine(found: _Lookup, rays: FiredRays, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Range, hit probability and intensity (k,) of the rays `rows` (k,) that at least one scan fired, too."""
    measured, weight, surface_m = found.range_m[:, rows], found.weight[:, rows], rays.range_m[rows]
    returned = weight * (measured > 0)
    hit = (returned.sum(axis=0) + _SURFACE_WEIGHT * rays.hit[rows]) / (weight.sum(axis=0) + _SURFACE_WEIGHT)
    near_m = _AGREE_M + _AGREE_PER_RANGE * measured
    agrees = np.stack([np.abs(one - measured) < near_m for one in measured])
    support = np.where(returned > 0, (returned[:, None] * agrees).sum(axis=0), 0.0)
    by_surface = (returned > 0) & (np.abs(surface_m - measured) < near_m)
    of_surface = _SURFACE_WEIGHT * np.isfinite(surface_m) * ~_is_stale(by_surface, returned, found.frames)
    support = support + by_surface * of_surface
    best, column = support.argmax(axis=0), np.arange(len(rows))
    own = of_surface + (returned * by_surface).sum(axis=0) * (of_surface > 0)
    is_measured = (returned[best, column] > 0) & ((support[best, column] > own) | by_surface[best, column])
    member = returned * agrees[best, :, column].T
    range_m = np.where(is_measured, _level(member, found.moved_m[:, rows], measured), surface_m)
    shine = (member * found.intensity[:, rows]).sum(axis=0) / np.maximum(member.sum(axis=0), 1e-6)
    intensity = np.where(is_measured, shine, rays.intensity[rows])
    return range_m.astype(np.float32), hit.astype(np.float32), intensity.astype(np.float32)


def _is_stale(by_surface: np.ndarray, returned: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """Whether (r,) the scans beside the sweep disagree with the surfels, and scans farther away agree.

    Then something has moved, and the surfels, which show another time, do not count.
    """
    beside = np.abs(frames) < _BESIDE_FRAMES
    now, then = returned[beside] > 0, by_surface[~beside]
    stale: np.ndarray = now.any(axis=0) & ~by_surface[beside].any(axis=0) & then.any(axis=0)
    return stale


def _level(weight: np.ndarray, moved_m: np.ndarray, range_m: np.ndarray) -> np.ndarray:
    """Range (r,) at the sweep's own pose, by a weighted line through ranges (k, r) over offsets (k, r)."""
    total = np.maximum(weight.sum(axis=0), 1e-6)
    moved, mean = (weight * moved_m).sum(axis=0) / total, (weight * range_m).sum(axis=0) / total
    spread = (weight * np.square(moved_m - moved)).sum(axis=0) / total
    slope = (weight * (moved_m - moved) * (range_m - mean)).sum(axis=0) / total
    level: np.ndarray = mean - moved * slope / (spread + _STILL_M**2)
    return level
