"""What scans of a drive look like as a whole: how many rays return, and how their intensities are spread.

A rendered scan is held against the training scans nearest in time. The limits come from the training scans
alone. Knowing nothing is one way to be wrong: every ray returns (or none), every intensity is the median. A
rendered scan is doubted when it is nearer to that than to the recording, so at half the way. It may differ
as much as training scans of one drive do among themselves, and by what a sensor's steps round away.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from nvsf_core.errors import DataError

_LEVELS = 100
"""Steps of intensity, 0.01 each: what KITTI's and KITTI-360's files tell apart."""
_HALF_WAY = 0.5
_SMALLEST_LIMIT = 0.01
"""A percentage point of the rays, and one step of intensity."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanNorms:
    """The training scans of a drive, n of them in the order of time."""

    time_s: np.ndarray
    """(n,) float64."""
    firings: np.ndarray
    """(n,) of each laser in the turn."""
    lasers: int
    """That ever returned."""
    hit_rate: np.ndarray
    """(n,) share of the rays that returned."""
    spread: np.ndarray
    """(n, 101) of intensities, as of `intensity_spread`."""

    @property
    def hit_rate_limit(self) -> float:
        """How far a rendered scan's hit rate may be from the nearest training scans'."""
        typical = float(np.median(self.hit_rate))
        knowing_nothing = min(typical, 1.0 - typical)
        return max(_SMALLEST_LIMIT, _HALF_WAY * knowing_nothing, float(np.ptp(self.hit_rate)))

    @property
    def intensity_limit(self) -> float:
        """How far a rendered scan's intensities may be spread from the nearest training scans'."""
        return spread_limit(self.spread)

    def hit_rate_apart(self, returns: int, time_s: float) -> float:
        """Hit rate of a scan at a time, less the rate of the two training scans nearest to it."""
        near = self._nearest(time_s)
        rays = self.lasers * float(self.firings[near].mean())
        return returns / rays - float(self.hit_rate[near].mean())

    def intensities_apart(self, intensity: np.ndarray, time_s: float) -> float:
        """Distance of intensities (m,), m > 0, from those of the two training scans nearest in time."""
        near = self._nearest(time_s)
        return spread_distance(intensity_spread(intensity), self.spread[near].mean(axis=0))

    def _nearest(self, time_s: float) -> np.ndarray:
        return np.argsort(np.abs(self.time_s - time_s), kind="stable")[:2]


def scan_norms(
    time_s: np.ndarray, firings: np.ndarray, lasers: int, offsets: np.ndarray, intensity: np.ndarray
) -> ScanNorms:
    """The norms of n training scans, whose returns lie one scan behind the other.

    Args:
        time_s: (n,).
        firings: (n,) of each laser in a turn, > 0.
        lasers: That ever returned, > 0.
        offsets: (n + 1,) where each scan's returns begin; every scan has some.
        intensity: (N,) of all returns.

    Raises:
        DataError: There is no scan, or one without rays or returns.
    """
    returns = np.diff(offsets)
    if len(returns) == 0 or lasers < 1 or (returns < 1).any() or (firings < 1).any():
        raise DataError(
            f"norms of scans: expected scans with rays and returns, found {len(returns)} scans, {lasers} "
            f"lasers, {int((returns < 1).sum())} scans without a return; leave those out"
        )
    parts = [intensity[start:end] for start, end in pairwise(offsets)]
    return ScanNorms(
        time_s=np.asarray(time_s, np.float64),
        firings=np.asarray(firings),
        lasers=lasers,
        hit_rate=returns / (firings * float(lasers)),
        spread=np.stack([intensity_spread(part) for part in parts]),
    )


def intensity_spread(intensity: np.ndarray) -> np.ndarray:
    """Cumulative histogram (101,) float64 of intensities (m,) in [0, 1], m > 0, in steps of 0.01.

    Raises:
        DataError: There is none, or one is not finite.
    """
    if intensity.size == 0 or not np.isfinite(intensity).all():
        broken = int(np.count_nonzero(~np.isfinite(intensity)))
        raise DataError(f"intensities: expected finite ones, found {intensity.size}, {broken} of them not")
    level = np.rint(np.clip(intensity, 0.0, 1.0) * _LEVELS).astype(np.int64)
    total: np.ndarray = np.cumsum(np.bincount(level, minlength=_LEVELS + 1)) / float(intensity.size)
    return total


def spread_limit(spread: np.ndarray) -> float:
    """How far one more cumulative histogram may be from n recorded ones (n, 101), n > 0.

    Half the way to all of it at the median, or as far as the recorded ones are apart.
    """
    together = spread.mean(axis=0)
    at_median = (np.arange(_LEVELS + 1) >= int(np.searchsorted(together, 0.5))).astype(np.float64)
    apart = np.abs(spread[:, None] - spread[None]).mean(axis=2).max()
    return max(_SMALLEST_LIMIT, _HALF_WAY * spread_distance(together, at_median), float(apart))


def spread_distance(one: np.ndarray, other: np.ndarray) -> float:
    """Earth mover's distance of two cumulative histograms (101,): how far intensities would have to move.

    W1 = integral of |F - G|, here the sum over steps of 0.01; 0 for equal ones, at most 1.
    """
    return float(np.abs(one - other).sum() / _LEVELS)
