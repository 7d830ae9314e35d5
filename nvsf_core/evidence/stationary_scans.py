"""Looks rays up in stationary scans: where the sensor stood or crawled, it fired each ray several times.

Range, hit probability and intensity of such a ray are combined from the nearest training scans, weighted by
their distance in time, and from the surfels, which count as one more scan. Where a car drives by the scans
disagree, and those nearest in time decide. Or they are copied from the scan nearest in time, in scenes where
left-out scans show that this is better.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from nvsf_core.evidence.drop_prior import DropPrior, FiredCells
from nvsf_core.geometry.se3 import log_so3
from nvsf_core.kernels.stationary_lookup import NearScans, combine_stationary
from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.sensors.sweep_clock import SweepClock

MOST_APART_M = 0.3
"""Scans farther than this from every other pose are not kept: no ray's footprint is wider."""
NEAREST_SCANS = 12
"""Most scans that are looked up."""
_FADE = 1.5
"""A scan k frames away has the weight k^-1.5: the two scans beside a sweep outweigh all others."""
_BESIDE_FRAMES = 1.5
"""Scans nearer to a sweep than this are beside it."""
_SAME_INSTANT_S = 1e-6
_MOMENTS = 17
"""Azimuths of a sweep at whose instants the sensor's poses are compared."""


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
    """(r,) `sweep_fraction` of the firings' azimuths, -0.5..0.5."""
    range_m: np.ndarray
    """(r,) float32 metres, infinite where the ray meets no surface."""
    hit: np.ndarray
    """(r,) float32 probability of a return."""
    intensity: np.ndarray
    """(r,) float32."""
    clock: SweepClock = field(default_factory=SweepClock)
    """When in the sweep each azimuth is measured."""


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


# Wide: the scans with their clocks, the sweep's rays, its instant and the path are independent of each other.
def look_up_stationary(
    stationary: StationaryScans,
    prior: DropPrior,
    rays: FiredRays,
    instant_s: float,
    trajectory: Trajectory,
    period_s: float,
    *,
    leave_out: int | None = None,
    clocks: Sequence[SweepClock] = (),
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
        clocks: When in each training scan an azimuth was measured; empty = as by `SweepClock()`.
    """
    apart_s = np.abs(prior.time_s[stationary.scan] - instant_s)
    order = np.argsort(apart_s, kind="stable")
    order = order[stationary.scan[order] != leave_out] if leave_out is not None else order
    frame_s = float(np.median(np.diff(trajectory.times_s))) if len(trajectory.times_s) > 1 else period_s
    fraction = np.linspace(-0.5, 0.5, _MOMENTS)
    own_s = instant_s + rays.clock.elapsed(fraction) * period_s
    there = list[tuple[int, np.ndarray, np.ndarray]]()
    for row in order[:NEAREST_SCANS].tolist():
        scan = int(stationary.scan[row])
        elapsed = (clocks[scan] if clocks else SweepClock()).elapsed(fraction)
        there.append((row, *_apart(prior.time_s[scan] + elapsed * period_s, own_s, trajectory)))
    there = [one for one in there if np.abs(one[1]).min() < MOST_APART_M]
    rendered = rays.range_m.copy(), rays.hit.copy(), rays.intensity.copy()
    if there:
        scans = _near_scans(stationary, prior, there, instant_s, frame_s)
        laser, fraction = rays.laser.astype(np.int64), rays.fraction.astype(np.float64)
        combine_stationary(laser, fraction, rendered, scans, bool(stationary.is_copied))
    return rendered


def _apart(scan_s: np.ndarray, sweep_s: np.ndarray, trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Metres (17,), negative for earlier scans, and radians (17,) between a scan's poses and a sweep's.

    At the instants (17,) at which each measured even azimuths.
    """
    turned, moved = trajectory.at(scan_s)
    turn, place = trajectory.at(sweep_s)
    apart_m = np.linalg.norm(moved - place, axis=1)
    angle_rad = np.linalg.norm(log_so3(np.swapaxes(turn, 1, 2) @ turned), axis=1)
    return np.copysign(apart_m, scan_s - sweep_s), angle_rad


def _near_scans(
    stationary: StationaryScans,
    prior: DropPrior,
    there: list[tuple[int, np.ndarray, np.ndarray]],
    instant_s: float,
    frame_s: float,
) -> NearScans:
    """As the kernel takes them; `there` holds each scan's row, offsets and angles from `_apart`."""
    row = np.array([one[0] for one in there])
    scan = stationary.scan[row]
    frames = np.abs(prior.time_s[scan] - instant_s) / frame_s
    return NearScans(
        row, stationary.range_m, stationary.intensity, prior.fraction[scan],
        np.array([prior.firings_of(int(one)) for one in scan]), np.stack([one[1] for one in there]),
        np.stack([one[2] for one in there]), (np.maximum(frames, 1.0) ** -_FADE).astype(np.float32),
        frames < _BESIDE_FRAMES,
    )  # fmt: skip
