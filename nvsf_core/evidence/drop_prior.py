"""Hit priors: in what share of the nearest training scans a laser had a return at the same angle.

Windows, puddles and the sky drop the same rays scan after scan. A scan whose lasers could not be recovered
(rain or snow) is left out: it had returns, but nobody knows of which rays.

Gaps of the recorded unit are firings that never return, whatever stands there: parts of its vehicle hide
them, or its own housing. The HDL-64E on KITTI-360's car has a comb of gaps on both sides. They are the same
wherever the vehicle drives, while what the scene drops moves past. They belong to this unit on this vehicle
alone: to another sensor they tell nothing.
"""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from nvsf_core.errors import DataError
from nvsf_core.sensors.beam_table import firing_phase

GAP_CELLS = 2000
"""Cells around the sensor."""
_LEAST_SCANS = 4
"""Scans at different places in which a firing must have met a surface."""
_NEVER_SHARE, _SELDOM_SHARE = 0.05, 0.5
"""Largest share of those that return: in a gap, and at its blurred ends."""
_END_CELLS = 3
"""Cells that a blurred end is long at most."""
_APART_M = 1.0


@dataclass(frozen=True, slots=True)
class DropPrior:
    """Returns of n training scans in a grid of lasers and firings."""

    time_s: np.ndarray
    """(n,) float64: instant of each training scan."""
    fraction: np.ndarray
    """(n, f) float32: sweep fraction of each firing, ascending; infinite after the last firing."""
    is_hit: np.ndarray
    """(n, lasers, f) bool: whether the ray returned."""

    @property
    def laser_count(self) -> int:
        """Number of the sensor's lasers, including those that never returned."""
        return self.is_hit.shape[1]

    @property
    def is_unidentified(self) -> np.ndarray:
        """(n,) bool: no return's laser is known, though other scans' are; all False where no scan's are."""
        speaks = np.asarray(self.is_hit.any(axis=(1, 2)))
        return ~speaks & bool(speaks.any())

    def nearest_scans(self, time_s: float, count: int, *, leave_out_s: float | None = None) -> np.ndarray:
        """Indices (k,) of the at most `count` training scans nearest to a time, nearest first.

        Left out are the scan at `leave_out_s` and, unless only those are left, unidentified ones.

        Raises:
            DataError: No scan is left.
        """
        order = np.argsort(np.abs(self.time_s - time_s), kind="stable")
        if leave_out_s is not None:
            order = order[np.abs(self.time_s[order] - leave_out_s) > 1e-6]
        if len(order) == 0:
            raise DataError(f"ray-drop prior: expected another training scan than the one at {leave_out_s} s")
        speaking = order[~self.is_unidentified[order]]
        return (speaking if len(speaking) > 0 else order)[:count]

    def hit_prior(self, laser: np.ndarray, fraction: np.ndarray, scans: np.ndarray) -> np.ndarray:
        """Share (r,) float32 of `scans` whose firing nearest to a ray (laser, fraction: (r,)) returned."""
        total = np.zeros(len(laser), np.float32)
        for scan in scans:
            total += self.is_hit[scan, laser, self.nearest_firing(scan, fraction)]
        return total / np.float32(len(scans))

    def hit_prior_of_sweep(self, lasers: np.ndarray, fraction: np.ndarray, scans: np.ndarray) -> np.ndarray:
        """`hit_prior` (l, f) of a whole sweep: all lasers (l,) fire at the sweep fractions (f,)."""
        total = np.zeros((len(lasers), len(fraction)), np.float32)
        for scan in scans:
            # Whole rows first: they are contiguous in memory.
            total += self.is_hit[scan][lasers][:, self.nearest_firing(scan, fraction)]
        return total / np.float32(len(scans))

    def nearest_firing(self, scan: int, fraction: np.ndarray) -> np.ndarray:
        """Firings (r,) int64 of a scan that are nearest to the sweep fractions (r,)."""
        firings = self.fraction[scan][: self.firings_of(scan)]
        right = np.minimum(np.searchsorted(firings, fraction), len(firings) - 1)
        left = np.maximum(right - 1, 0)
        return np.where(fraction - firings[left] < firings[right] - fraction, left, right)

    def firing_phase(self) -> float:
        """The `firing_phase` of all scans."""
        count = np.isfinite(self.fraction).sum(axis=1, keepdims=True)
        steps = (self.fraction.astype(np.float64) + 0.5) * count
        return firing_phase(steps[self.is_hit.any(axis=1)])

    def firings_of(self, scan: int) -> int:
        """Number of firings in a scan."""
        return int(np.isfinite(self.fraction[scan]).sum())


@dataclass(frozen=True, slots=True)
class FiredCells:
    """Cells of N returns in the grid of a `DropPrior`."""

    scan: np.ndarray
    """(N,) int64 training scan."""
    column: np.ndarray
    """(N,) int64 firing."""
    is_known: np.ndarray
    """(N,) bool: laser and firing are known; where not, the other arrays mean nothing."""


# Wide: each array is a column of the returns or of the scans.
def build_drop_prior(
    laser: np.ndarray,
    firing: np.ndarray,
    sweep_fraction: np.ndarray,
    offsets: np.ndarray,
    firings: np.ndarray,
    time_s: np.ndarray,
    *,
    lasers: int,
    nominal_firings: int,
) -> DropPrior:
    """The grid of N returns of n training scans.

    Args:
        laser: (N,) int, 0 on top, -1 unknown.
        firing: (N,) int, number within the sweep, -1 unknown.
        sweep_fraction: (N,) -azimuth / 2 pi of the firings, -0.5..0.5, NaN unknown.
        offsets: (n + 1,) int: scan k's returns are offsets[k] .. offsets[k + 1] - 1.
        firings: (n,) int, firings of each scan. 0 = unknown: its returns are assigned by their sweep fraction
            to evenly spaced nominal firings.
        time_s: (n,) instants of the scans.
        lasers: Number of the sensor's lasers.
        nominal_firings: The sensor's usual number of firings in a sweep.
    """
    fraction, cells = find_cells(
        laser, firing, sweep_fraction, offsets, firings, nominal_firings=nominal_firings
    )
    is_hit = np.zeros((len(time_s), lasers, fraction.shape[1]), bool)
    known = cells.is_known
    is_hit[cells.scan[known], laser[known], cells.column[known]] = True
    return DropPrior(np.asarray(time_s, np.float64), fraction, is_hit)


def find_cells(
    laser: np.ndarray,
    firing: np.ndarray,
    sweep_fraction: np.ndarray,
    offsets: np.ndarray,
    firings: np.ndarray,
    *,
    nominal_firings: int,
) -> tuple[np.ndarray, FiredCells]:
    """`DropPrior.fraction` (n, f) of n training scans, and the grid cells of their N returns.

    Args:
        laser: (N,) int, as for `build_drop_prior`.
        firing: (N,) int, likewise.
        sweep_fraction: (N,), likewise.
        offsets: (n + 1,) int, likewise.
        firings: (n,) int, likewise.
        nominal_firings: Likewise.
    """
    n = len(firings)
    counts = np.where(firings > 0, firings, nominal_firings)
    fraction = np.full((n, counts.max()), np.inf, np.float32)
    columns, is_known = np.zeros(len(laser), np.int64), np.zeros(len(laser), bool)
    for scan in range(n):
        part = slice(offsets[scan], offsets[scan + 1])
        even = ((np.arange(counts[scan]) + 0.5) / counts[scan] - 0.5).astype(np.float32)
        column = firing[part].astype(np.int64)
        known = (laser[part] >= 0) & np.isfinite(sweep_fraction[part])
        if firings[scan] == 0:
            column = np.clip(
                ((sweep_fraction[part] + 0.5) * counts[scan]).astype(np.int64), 0, counts[scan] - 1
            )
        else:
            known &= column >= 0
            even[column[known]] = sweep_fraction[part][known]
            even = np.maximum.accumulate(even)
        fraction[scan, : counts[scan]] = even
        columns[part], is_known[part] = column, known
    return fraction, FiredCells(np.repeat(np.arange(n), np.diff(offsets)), columns, is_known)


def places_apart(position_m: np.ndarray, most: int) -> np.ndarray:
    """Numbers (k,) of at most `most` scans, each at least a metre from the one before; positions (n, 3)."""
    chosen = list[int]()
    for number, position in enumerate(position_m):
        if not chosen or np.linalg.norm(position - position_m[chosen[-1]]) >= _APART_M:
            chosen.append(number)
    some = np.unique(np.linspace(0, max(0, len(chosen) - 1), min(most, len(chosen))).round().astype(np.int64))
    return np.array(chosen, np.int64)[some]


def find_unit_gaps(prior: DropPrior, scans: np.ndarray, is_met: np.ndarray) -> np.ndarray | None:
    """Which (lasers, 2000) bool cells of laser and sweep fraction lie in a gap.

    Args:
        prior: Returns of the training scans.
        scans: (k,) some of them, recorded at different places.
        is_met: (k, lasers, 2000) bool: whether a ray through the middle of a cell meets a surface.

    Returns:
        None where there are too few scans to tell a gap from what the scene drops.
    """
    if len(scans) < _LEAST_SCANS:
        return None
    middle = ((np.arange(GAP_CELLS) + 0.5) / GAP_CELLS - 0.5).astype(np.float32)
    met, returned = np.zeros((2, prior.laser_count, GAP_CELLS), np.int64)
    for scan, meets in zip(scans, is_met, strict=True):
        met += meets
        returned += meets & prior.is_hit[scan][:, prior.nearest_firing(int(scan), middle)]
    is_told = met >= max(_LEAST_SCANS, len(scans) // 2)
    never = is_told & (returned <= _NEVER_SHARE * met)
    seldom = is_told & (returned < _SELDOM_SHARE * met)
    along = np.ones((1, 3), bool)
    return np.asarray(ndimage.binary_dilation(never, along, iterations=_END_CELLS, mask=seldom) | never)


def cells_of(fraction: np.ndarray, cells: int) -> np.ndarray:
    """Cell numbers (f,) int64 of sweep fractions (f,) -0.5..0.5; a sweep has `cells` cells."""
    return np.clip(np.floor((fraction + 0.5) * cells), 0, cells - 1).astype(np.int64)
