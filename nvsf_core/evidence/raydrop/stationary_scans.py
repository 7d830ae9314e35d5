"""Scans recorded where the sensor stood or crawled: the same ray was fired several times.

The range of such a ray is taken from the nearest training scans that fired it, and not from surfaces. The
scans are weighted by their distance in time, and the range from surfaces counts as one more scan: where a
car drives by the scans disagree, and those around the ray's own time decide.
"""

from dataclasses import dataclass

import numpy as np

from nvsf_core.evidence.raydrop.prior import DropPrior, FiredCells
from nvsf_core.geometry.se3 import log_so3
from nvsf_core.sensors.sweep import Trajectory

MOST_APART_M = 0.3
"""No footprint within the sensor's reach is wider: scans farther from every other pose are not kept."""
NEAREST_SCANS = 12
_NOISE_M = 0.02
"""Of a measured range: moving less than this along a ray changes nothing."""
_AGREE_M, _AGREE_PER_RANGE = 0.1, 0.005
"""Two ranges of one surface differ by less."""
_SURFACE_WEIGHT = 1.0
"""Of the answer from surfaces among the scans: as much as a scan of the frame before or after."""
_FOOTPRINT_STEPS = 1.5
"""Of the angle from firing to firing: how far a ray may be off and still meet the same footprint."""
_FADE = 1.5
"""Power of the frames to a scan by which its voice fades: two scans beside outweigh all the others."""
_BESIDE_FRAMES = 1.5
"""Scans nearer than this to a sweep are beside it."""
_STILL_M = 0.02
"""Where the sensor moved less than this the ranges' trend is noise, and not followed."""
_SAME_INSTANT_S = 1e-6
_MOMENTS = 17
_CHUNK_RAYS = 65536


@dataclass(frozen=True, slots=True, eq=False)
class StationaryScans:
    """Ranges by laser and firing of m training scans that were taken at nearly the same place as another."""

    scan: np.ndarray
    """(m,) int32 which training scans, ascending."""
    range_m: np.ndarray
    """(m, lasers, f) float32 along the laser's ray; 0 = no return."""
    intensity: np.ndarray
    """(m, lasers, f) float32."""

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
    """r rays of one sweep of the recording sensor, and what surfaces answer them."""

    laser: np.ndarray
    """(r,) int."""
    fraction: np.ndarray
    """(r,) sweeps after the sweep's instant."""
    range_m: np.ndarray
    """(r,) float32, infinite where no surface answers."""
    hit: np.ndarray
    """(r,) float32 probability of a return."""
    intensity: np.ndarray
    """(r,) float32."""


@dataclass(frozen=True, slots=True, eq=False)
class _Asked:
    """What k scans say of r rays, nearest scan in time first."""

    range_m: np.ndarray
    """(k, r) float32, 0 = no return."""
    intensity: np.ndarray
    """(k, r) float32."""
    weight: np.ndarray
    """(k, r) float32: 1 a frame away, less farther off, 0 where the sensor was elsewhere."""
    moved_m: np.ndarray
    """(k, r) float32: how far the sensor was behind (negative) or ahead."""
    frames: np.ndarray
    """(k,) float64 frames from the sweep to each scan, negative before it."""


def find_stationary_scans(time_s: np.ndarray, trajectory: Trajectory) -> np.ndarray:
    """Which (m,) int64 of the training scans at `time_s` (n,) were taken nearly where any other frame was."""
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
    """Lay the returns (N,) of the training scans `scan` (m,) on the grid of lasers and firings."""
    number = np.full(len(prior.time_s), -1)
    number[scan] = np.arange(len(scan))
    kept = cells.is_known & (number[cells.scan] >= 0)
    cell = (number[cells.scan[kept]], laser[kept], cells.column[kept])
    shape = (len(scan), *prior.is_hit.shape[1:])
    ranges, shine = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    ranges[cell], shine[cell] = range_m[kept], intensity[kept]
    return StationaryScans(scan.astype(np.int32), ranges, shine)


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
    """Range (inf = nothing answers), hit probability and intensity (r,) float32 of a sweep's rays.

    Where no training scan was fired from the same place they are what the surfaces say, bit by bit.

    Args:
        stationary: What was measured.
        prior: Of the same drive.
        rays: Any number of rays of the sweep.
        instant_s: Of the sweep's pose.
        trajectory: All recorded poses.
        period_s: Seconds of a turn.
        leave_out: A training scan that is not asked.
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
        asked = _ask(stationary, prior, some, there, instant_s, frame_s)
        rows = np.flatnonzero(asked.weight.any(axis=0))
        for target, values in zip(rendered, _decide(asked, some, rows), strict=True):
            target[part][rows] = values
    return rendered


def _apart(
    scan_s: float, instant_s: float, trajectory: Trajectory, period_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """How far (17,) metres, negative = before, and turned (17,) radians a scan's sensor was over the turn."""
    lag_s = np.linspace(-0.5, 0.5, _MOMENTS) * period_s
    turned, moved = trajectory.at(scan_s + lag_s)
    turn, place = trajectory.at(instant_s + lag_s)
    apart_m = np.linalg.norm(moved - place, axis=1)
    angle_rad = np.linalg.norm(log_so3(np.swapaxes(turn, 1, 2) @ turned), axis=1)
    return np.copysign(apart_m, scan_s - instant_s), angle_rad


def _ask(
    stationary: StationaryScans,
    prior: DropPrior,
    rays: FiredRays,
    there: list[tuple[int, np.ndarray, np.ndarray]],
    instant_s: float,
    frame_s: float,
) -> _Asked:
    moments = np.linspace(-0.5, 0.5, _MOMENTS)
    shape = (len(there), len(rays.laser))
    scan_s = np.array([prior.time_s[stationary.scan[row]] for row, _, _ in there])
    frames = (scan_s - instant_s) / frame_s
    ranges, shine, weight, moved = (np.zeros(shape, np.float32) for _ in range(4))
    asked = _Asked(ranges, shine, weight, moved, frames)
    for k, (row, moved_m, angle_rad) in enumerate(there):
        scan = int(stationary.scan[row])
        column = prior.nearest_firing(scan, rays.fraction)
        step_rad = 2.0 * np.pi / prior.firings_of(scan)
        asked.range_m[k] = stationary.range_m[row, rays.laser, column]
        asked.intensity[k] = stationary.intensity[row, rays.laser, column]
        asked.moved_m[k] = np.interp(rays.fraction, moments, moved_m)
        reach_m = np.where(asked.range_m[k] > 0, asked.range_m[k], np.minimum(rays.range_m, 1e3))
        footprint_m = _NOISE_M + _FOOTPRINT_STEPS * step_rad * reach_m
        off_m = np.abs(asked.moved_m[k]) + np.interp(rays.fraction, moments, angle_rad) * reach_m
        asked.weight[k] = np.where(off_m < footprint_m, max(abs(frames[k]), 1.0) ** -_FADE, 0.0)
    return asked


def _decide(asked: _Asked, rays: FiredRays, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Range, hit probability, intensity of those of the rays (rows) that any scan was fired along."""
    measured, weight, surface_m = asked.range_m[:, rows], asked.weight[:, rows], rays.range_m[rows]
    returned = weight * (measured > 0)
    hit = (returned.sum(axis=0) + _SURFACE_WEIGHT * rays.hit[rows]) / (weight.sum(axis=0) + _SURFACE_WEIGHT)
    near_m = _AGREE_M + _AGREE_PER_RANGE * measured
    agrees = np.stack([np.abs(one - measured) < near_m for one in measured])
    support = np.where(returned > 0, (returned[:, None] * agrees).sum(axis=0), 0.0)
    by_surface = (returned > 0) & (np.abs(surface_m - measured) < near_m)
    of_surface = _SURFACE_WEIGHT * np.isfinite(surface_m) * ~_is_stale(by_surface, returned, asked.frames)
    support = support + by_surface * of_surface
    best, column = support.argmax(axis=0), np.arange(len(rows))
    own = of_surface + (returned * by_surface).sum(axis=0) * (of_surface > 0)
    is_measured = (returned[best, column] > 0) & ((support[best, column] > own) | by_surface[best, column])
    member = returned * agrees[best, :, column].T
    range_m = np.where(is_measured, _level(member, asked.moved_m[:, rows], measured), surface_m)
    shine = (member * asked.intensity[:, rows]).sum(axis=0) / np.maximum(member.sum(axis=0), 1e-6)
    intensity = np.where(is_measured, shine, rays.intensity[rows])
    return range_m.astype(np.float32), hit.astype(np.float32), intensity.astype(np.float32)


def _is_stale(by_surface: np.ndarray, returned: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """Whether (r,) the scans beside the sweep returned otherwise than the surfaces, and far ones as they do.

    Then something moved, the surfaces are of another time, and have no voice.
    """
    beside = np.abs(frames) < _BESIDE_FRAMES
    now, then = returned[beside] > 0, by_surface[~beside]
    stale: np.ndarray = now.any(axis=0) & ~by_surface[beside].any(axis=0) & then.any(axis=0)
    return stale


def _level(weight: np.ndarray, moved_m: np.ndarray, range_m: np.ndarray) -> np.ndarray:
    """Weighted line through ranges (k, r) by how far the sensor was, at the place itself: (r,)."""
    total = np.maximum(weight.sum(axis=0), 1e-6)
    moved, mean = (weight * moved_m).sum(axis=0) / total, (weight * range_m).sum(axis=0) / total
    spread = (weight * np.square(moved_m - moved)).sum(axis=0) / total
    slope = (weight * (moved_m - moved) * (range_m - mean)).sum(axis=0) / total
    level: np.ndarray = mean - moved * slope / (spread + _STILL_M**2)
    return level
