"""Which beams never return: training scans vote, laser by laser and firing by firing.

Windows, puddles and the sky drop the same beams scan after scan. A laser's firing of a scan that is to
be predicted asks the nearest training scans whether their firing at the same angle returned. A scan in
rain or snow whose lasers could not be recovered returned as well, and nobody knows where: it has no vote.
"""

from dataclasses import dataclass

import numpy as np

from nvsf_core.errors import DataError


@dataclass(frozen=True, slots=True)
class DropPrior:
    """Hits of the training scans, in the grid of lasers and firings."""

    time_s: np.ndarray
    """(n,) float64: time of each training scan."""
    fraction: np.ndarray
    """(n, f) float32: sweep fraction of each firing, ascending; infinite behind the last."""
    is_hit: np.ndarray
    """(n, lasers, f) bool: whether the laser returned."""

    @property
    def laser_count(self) -> int:
        """Rows of the grid, whether or not each was ever seen."""
        return self.is_hit.shape[1]

    @property
    def is_unidentified(self) -> np.ndarray:
        """(n,) bool: scans of which no laser is known, where others' are; none where no scan's is."""
        speaks = np.asarray(self.is_hit.any(axis=(1, 2)))
        return ~speaks & bool(speaks.any())

    def nearest_scans(self, time_s: float, count: int, *, leave_out_s: float | None = None) -> np.ndarray:
        """Indices of the training scans nearest in time; a scan at `leave_out_s` itself is not asked.

        Nor are silent ones, unless no other is left.

        Raises:
            DataError: No scan is left to ask.
        """
        order = np.argsort(np.abs(self.time_s - time_s), kind="stable")
        if leave_out_s is not None:
            order = order[np.abs(self.time_s[order] - leave_out_s) > 1e-6]
        if len(order) == 0:
            raise DataError(f"ray-drop prior: expected another training scan than the one at {leave_out_s} s")
        speaking = order[~self.is_unidentified[order]]
        return (speaking if len(speaking) > 0 else order)[:count]

    def hit_prior(self, laser: np.ndarray, fraction: np.ndarray, scans: np.ndarray) -> np.ndarray:
        """Share (r,) float32 of `scans` whose firing nearest to each ray (laser, fraction: (r,)) returned."""
        total = np.zeros(len(laser), np.float32)
        for scan in scans:
            total += self.is_hit[scan, laser, self.nearest_firing(scan, fraction)]
        return total / np.float32(len(scans))

    def hit_prior_of_sweep(self, lasers: np.ndarray, fraction: np.ndarray, scans: np.ndarray) -> np.ndarray:
        """`hit_prior` (l, f) of a whole turn: lasers (l,) that all fire at the sweep fractions (f,)."""
        total = np.zeros((len(lasers), len(fraction)), np.float32)
        for scan in scans:
            # Whole rows first: they lie in one piece.
            total += self.is_hit[scan][lasers][:, self.nearest_firing(scan, fraction)]
        return total / np.float32(len(scans))

    def nearest_firing(self, scan: int, fraction: np.ndarray) -> np.ndarray:
        """Columns (r,) int64 of a scan's firings nearest to the sweep fractions (r,)."""
        firings = self.fraction[scan][: self.firings_of(scan)]
        right = np.minimum(np.searchsorted(firings, fraction), len(firings) - 1)
        left = np.maximum(right - 1, 0)
        nearest: np.ndarray = np.where(fraction - firings[left] < firings[right] - fraction, left, right)
        return nearest

    def firings_of(self, scan: int) -> int:
        """How often each laser of a scan fired."""
        return int(np.isfinite(self.fraction[scan]).sum())


@dataclass(frozen=True, slots=True)
class FiredCells:
    """Where N returns lie in the grid of a `DropPrior`."""

    scan: np.ndarray
    """(N,) int64."""
    column: np.ndarray
    """(N,) int64 firing."""
    is_known: np.ndarray
    """(N,) bool: laser and firing are; the other arrays mean nothing where not."""


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
    """Fill the grid from flat returns (N,) of n scans with `offsets` (n + 1).

    Scans whose firings are unknown (`firings` 0) are laid on evenly spaced nominal ones by their time.
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
    """Each scan's sweep fractions (n, f), infinite behind the last, and where each return (N,) lies.

    Arguments as of `build_drop_prior`.
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
