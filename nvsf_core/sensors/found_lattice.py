"""The steps of a rotating LiDAR's encoder, found from its lasers' azimuths.

Each laser's returns follow the model of `tables.LaserTable`:
    azimuth = (column + phase_l) 2 pi / n + horizontal_offset_l / (r cos elevation_l)
It is periodic in the encoder's n steps: for each lever arm h that a laser may have, the spectrum of its
azimuths less h / rho has a peak at n, the highest for the true h.
Lasers that fire together leave the same pattern of columns, each shifted by its own constant.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

_ARMS_M = np.linspace(-0.08, 0.08, 81)
"""Lever arms to the left that are tried: sensors are less than 16 cm wide at their lasers."""
_BINS = 1 << 15
_MOST_STEPS = 12_000
_LEAST_MATCH = 12.0
"""Least height of a match of firing patterns, in standard deviations; KITTI's lasers have 31 and more."""
_LATTICE_PEAK = 0.6
"""Least height of the spectrum's peak, of 1, for an encoder's lattice."""
_ONE_PHASE = 0.9
"""Least length of the mean of the lasers' phases as unit vectors, for phases that are about one."""
_ONE_BEGIN = 0.95
"""Least height of the peak of all scans together, of that of each by itself."""


@dataclass(frozen=True, slots=True, eq=False)
class Lattice:
    """How L lasers fire in one rotation."""

    steps: int
    """Of the encoder; of a sensor without a lattice, its firings."""
    firings: int
    """In one rotation."""
    arms_m: np.ndarray
    """(L,) float64 lever arms to the left; 0 without a lattice, as phases and shifts are."""
    phases: np.ndarray
    """(L,) float64 steps."""
    shifts: np.ndarray
    """(L,) int64 steps between a laser's columns and those of lasers that fire with it."""
    words: str
    """What was found, for people."""


def find_lattice(groups: Sequence[np.ndarray], n_scans: int) -> Lattice:
    """The lattice of lasers, at least one.

    Args:
        groups: Of each laser (N, 4) float64, its points, metres, and the scan that each is of.
        n_scans: Scans numbered below this are whole; of later ones only some lasers are in the groups.
    """
    steps, peak, arms_m, phases = _lattice(groups)
    here = [points_m[points_m[:, 3] < n_scans] for points_m in groups]
    firings = _firings(here, n_scans)
    if peak < _LATTICE_PEAK:
        none = np.zeros(len(groups))
        words = f"no encoder's lattice (peak {peak:.2f}): lever arms to the side are taken as 0"
        return Lattice(firings, firings, none, none, np.zeros(len(groups), np.int64), words)
    columns = [_columns(*laser, steps) for laser in zip(here, arms_m, phases, strict=True)]
    shifts = _shifts(here, columns, n_scans, steps)
    firings = steps if _fires_at_every_step(here, columns) else min(firings, steps)
    return Lattice(steps, firings, arms_m, phases, shifts, f"an encoder of {steps} steps (peak {peak:.2f})")


def _lattice(groups: Sequence[np.ndarray]) -> tuple[int, float, np.ndarray, np.ndarray]:
    """Steps of the encoder, height of the peak, and each laser's lever arm (m) and phase (steps).

    The peak is 0 of a sensor that begins each sweep anywhere: some lattice fits a few scans by chance.
    """
    chosen = list(range(0, len(groups), max(1, len(groups) // 8)))
    mean = np.mean([_spectra(groups[k]).max(axis=0) for k in chosen], axis=0)
    mean[: min(64, len(mean))] = 0.0
    # A lattice of n steps also peaks at 2 n, 3 n, ...: the first high peak is n.
    steps = int(np.flatnonzero(mean >= 0.9 * mean.max())[0])
    arms_m, phases, peaks = np.zeros(len(groups)), np.zeros(len(groups)), np.zeros(len(groups))
    for k, points_m in enumerate(groups):
        azimuth, rho_m = _flat(points_m)
        waves = np.array([np.exp(1j * steps * (azimuth - arm / rho_m)).mean() for arm in _ARMS_M])
        best = int(np.abs(waves).argmax())
        arms_m[k], peaks[k] = _ARMS_M[best], abs(waves[best])
        phases[k] = np.angle(waves[best]) / (2.0 * np.pi)
    is_one = _has_one_begin([groups[k] for k in chosen], arms_m[chosen])
    return steps, float(np.median(peaks)) if is_one else 0.0, arms_m, _together(phases)


def _together(phases: np.ndarray) -> np.ndarray:
    """Phases (L,) in steps, of lasers with about one phase: none a whole step from the others.

    A phase of half a step is found as 0.5 of one laser and as -0.5 of the next.
    """
    wave = np.exp(2j * np.pi * phases).mean()
    middle = np.angle(wave) / (2.0 * np.pi)
    return phases if abs(wave) < _ONE_PHASE else middle + (phases - middle + 0.5) % 1.0 - 0.5


def _has_one_begin(groups: Sequence[np.ndarray], arms_m: np.ndarray) -> bool:
    """Whether all scans of lasers with lever arms (k,) lie on one lattice, as exactly as each by itself."""
    alone, together = np.zeros((2, _MOST_STEPS))
    for points_m, arm_m in zip(groups, arms_m, strict=True):
        azimuth, rho_m = _flat(points_m)
        angle, scan = np.mod(azimuth - arm_m / rho_m, 2.0 * np.pi), points_m[:, 3]
        waves = np.array([_wave(angle[scan == one]) for one in np.unique(scan)])
        returns = np.unique(scan, return_counts=True)[1]
        alone += np.average(np.abs(waves), axis=0, weights=returns)
        together += np.abs(np.average(waves, axis=0, weights=returns))
    alone[:64] = 0.0
    first = int(np.flatnonzero(alone >= 0.9 * alone.max())[0])
    return bool(together[first] >= _ONE_BEGIN * alone[first])


def _wave(angle_rad: np.ndarray) -> np.ndarray:
    """Mean of exp(-i n angle) over angles (k,) in [0, 2 pi), for each wave number n."""
    bins = np.minimum((angle_rad * (_BINS / (2.0 * np.pi))).astype(np.int64), _BINS - 1)
    return np.fft.rfft(np.bincount(bins, minlength=_BINS))[:_MOST_STEPS] / len(angle_rad)


def _spectra(points_m: np.ndarray) -> np.ndarray:
    """Height of each wave number for each lever arm tried, (arms, wave numbers)."""
    azimuth, rho_m = _flat(points_m)
    return np.array([np.abs(_wave(np.mod(azimuth - arm_m / rho_m, 2.0 * np.pi))) for arm_m in _ARMS_M])


def _flat(points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    azimuth: np.ndarray = np.arctan2(points_m[:, 1], points_m[:, 0])
    return azimuth, np.maximum(np.hypot(points_m[:, 0], points_m[:, 1]), 1e-3)


def _firings(groups: Sequence[np.ndarray], n_scans: int) -> int:
    """Firings of a sweep: as many as the fullest lasers have returns."""
    counts = np.array([len(points_m) / n_scans for points_m in groups])
    return max(1, round(float(np.percentile(counts, 98))))


def _columns(points_m: np.ndarray, arm_m: float, phase: float, steps: int) -> np.ndarray:
    """(N,) int64 step, in 0..steps - 1, at which each return of a laser was fired."""
    azimuth, rho_m = _flat(points_m)
    return np.mod(np.rint((azimuth - arm_m / rho_m) * steps / (2.0 * np.pi) - phase).astype(np.int64), steps)


def _fires_at_every_step(groups: Sequence[np.ndarray], columns: Sequence[np.ndarray]) -> bool:
    """Whether most returns of a laser lie one step from its next one in the same scan.

    Counts of returns do not tell it: of a ray in three nothing comes back.
    """
    gaps = []
    for points_m, column in zip(groups, columns, strict=True):
        order = np.lexsort((column, points_m[:, 3]))
        gap = np.diff(column[order])
        gaps.append(gap[gap > 0])
    counts = np.bincount(np.concatenate(gaps), minlength=2)
    return int(counts.argmax()) == 1


def _shifts(
    groups: Sequence[np.ndarray], columns: Sequence[np.ndarray], n_scans: int, steps: int
) -> np.ndarray:
    """(L,) int64 steps between each laser's columns and those of the fullest laser that fire together."""
    pattern = []
    for points_m, column in zip(groups, columns, strict=True):
        fired = np.zeros((n_scans, steps))
        fired[points_m[:, 3].astype(np.int64), column] = 1.0
        pattern.append(np.fft.rfft(fired - fired.mean(axis=1, keepdims=True)))
    reference = np.conj(pattern[int(np.argmax([len(one) for one in groups]))])
    shifts = np.zeros(len(groups), np.int64)
    for k, own in enumerate(pattern):
        # Phases alone: firings are nearly even, and their regular part agrees at many shifts.
        wave = own * reference
        match = np.fft.irfft((wave / np.maximum(np.abs(wave), 1e-9)).sum(axis=0), steps)
        best = int(match.argmax())
        # Where every column fires there is no pattern: nothing is shifted.
        if match[best] > _LEAST_MATCH * match.std():
            shifts[k] = -((best + steps // 2) % steps - steps // 2)
    return np.asarray(shifts - round(float(np.median(shifts))))
