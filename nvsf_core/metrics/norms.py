"""Typical statistics of a drive's training scans and images, which rendered ones must not be far from.

Statistics are the hit rate, the distribution of intensities, and the brightness of images. A rendered scan is
compared with the training scans nearest in time; limits are derived from training scans only. A model that
has learned nothing makes every ray return (or none), with the median intensity. The limit is half of the
distance to such a scan, but at least as far as the training scans are apart, or one step of rounding.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from nvsf_core.errors import DataError

_LEVELS = 100
"""Steps of intensity, 0.01 each: the resolution of KITTI's and KITTI-360's files."""
_HALF_WAY = 0.5
"""Limits are this share of the distance to a model that has learned nothing."""
_SMALLEST_LIMIT = 0.01
"""One percent of the rays, and one step of intensity."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanNorms:
    """Statistics of a drive's n training scans, in the order of time."""

    time_s: np.ndarray
    """(n,) float64."""
    firings: np.ndarray
    """(n,) firings of each laser in a sweep."""
    lasers: int
    """Number of lasers that ever had a return."""
    hit_rate: np.ndarray
    """(n,) share of the rays that returned."""
    spread: np.ndarray
    """(n, 101) `intensity_spread` of each scan."""

    @property
    def hit_rate_limit(self) -> float:
        """Largest difference of a rendered scan's hit rate from the nearest training scans'."""
        typical = float(np.median(self.hit_rate))
        knowing_nothing = min(typical, 1.0 - typical)
        return max(_SMALLEST_LIMIT, _HALF_WAY * knowing_nothing, float(np.ptp(self.hit_rate)))

    @property
    def intensity_limit(self) -> float:
        """Largest `spread_distance` of a rendered scan's intensities from the nearest training scans'."""
        return spread_limit(self.spread)

    def hit_rate_apart(self, returns: int, time_s: float) -> float:
        """Hit rate of a scan at a time, minus the mean rate of the two training scans nearest in time."""
        near = self._nearest(time_s)
        rays = self.lasers * float(self.firings[near].mean())
        return returns / rays - float(self.hit_rate[near].mean())

    def intensities_apart(self, intensity: np.ndarray, time_s: float) -> float:
        """`spread_distance` of intensities (m,), m > 0, from the two training scans nearest in time."""
        near = self._nearest(time_s)
        return spread_distance(intensity_spread(intensity), self.spread[near].mean(axis=0))

    def _nearest(self, time_s: float) -> np.ndarray:
        return np.argsort(np.abs(self.time_s - time_s), kind="stable")[:2]


def scan_norms(
    time_s: np.ndarray, firings: np.ndarray, lasers: int, offsets: np.ndarray, intensity: np.ndarray
) -> ScanNorms:
    """The norms of n training scans, whose returns are in one array, scan by scan.

    Args:
        time_s: (n,) ascending.
        firings: (n,) firings of each laser in a sweep, > 0.
        lasers: Number of lasers that ever had a return, > 0.
        offsets: (n + 1,) where each scan's returns begin, and N; no scan is empty.
        intensity: (N,) in 0..1, of all returns.

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
        DataError: There is no intensity, or one that is not finite.
    """
    if intensity.size == 0 or not np.isfinite(intensity).all():
        broken = int(np.count_nonzero(~np.isfinite(intensity)))
        raise DataError(f"intensities: expected finite ones, found {intensity.size}, {broken} of them not")
    level = np.rint(np.clip(intensity, 0.0, 1.0) * _LEVELS).astype(np.int64)
    return np.cumsum(np.bincount(level, minlength=_LEVELS + 1)) / float(intensity.size)


def spread_limit(spread: np.ndarray) -> float:
    """Largest `spread_distance` of a rendered cumulative histogram from n recorded ones (n, 101), n > 0.

    Half of the distance to a histogram with the median only, or the largest distance of two recorded ones.
    """
    together = spread.mean(axis=0)
    at_median = (np.arange(_LEVELS + 1) >= int(np.searchsorted(together, 0.5))).astype(np.float64)
    # One with all others at a time: all pairs at once would take gigabytes.
    apart = max(float(np.abs(spread - one).sum(axis=1).max()) for one in spread) / _LEVELS
    return max(_SMALLEST_LIMIT, _HALF_WAY * spread_distance(together, at_median), apart)


def spread_distance(one: np.ndarray, other: np.ndarray) -> float:
    """Earth mover's distance of two cumulative histograms (101,), 0..1: the mean shift of intensity.

    W1 = integral of |F - G|, here a sum over steps of 0.01.
    """
    return float(np.abs(one - other).sum() / _LEVELS)


LEAST_LEVELS = 8.0
"""Least standard deviation of an image that is not blank: below, a uniform grey reaches 30 dB PSNR."""
_TOP = 255.0
_ENOUGH_PX = 40_000
"""Pixels of an image that its statistics are taken from, about, evenly spaced."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageNorms:
    """Statistics of one camera's n training images."""

    seen: np.ndarray
    """(H, W) bool, the pixels that the statistics are taken from."""
    deviation: np.ndarray
    """(n,) standard deviation of each image's grey values, 0..255."""
    spread: np.ndarray
    """(n, 101) `intensity_spread` of each image's grey values."""

    @property
    def blank_below(self) -> float:
        """An image with a smaller standard deviation is blank: half of the least of the training images."""
        return max(LEAST_LEVELS, _HALF_WAY * float(self.deviation.min()))

    @property
    def greys_limit(self) -> float:
        """Largest `greys_apart` of a rendered image."""
        return spread_limit(self.spread)

    def deviation_of(self, image: np.ndarray) -> float:
        """Standard deviation of the grey values, 0..255, of an image (H, W, 3) uint8."""
        return float(_greys(image, self.seen).std()) * _TOP

    def greys_apart(self, image: np.ndarray) -> float:
        """`spread_distance` of an image's (H, W, 3) uint8 grey values to the nearest training image's."""
        own = intensity_spread(_greys(image, self.seen))
        return min(spread_distance(own, recorded) for recorded in self.spread)


def image_norms(images: np.ndarray, valid: np.ndarray) -> ImageNorms:
    """The norms of a camera's training images (n, H, W, 3) uint8, of the pixels `valid` (H, W) bool.

    Raises:
        DataError: There is no image, or no valid pixel.
    """
    if len(images) == 0 or not valid.any():
        raise DataError(
            f"norms of images: expected images with valid pixels, found {len(images)} images, "
            f"{int(valid.sum())} valid pixels; leave the camera out"
        )
    rows, columns = np.nonzero(valid)
    every = max(1, len(rows) // _ENOUGH_PX)
    seen = np.zeros_like(valid, dtype=np.bool_)
    seen[rows[::every], columns[::every]] = True
    greys = [_greys(image, seen) for image in images]
    return ImageNorms(
        seen=seen,
        deviation=np.array([float(grey.std()) * _TOP for grey in greys]),
        spread=np.stack([intensity_spread(grey) for grey in greys]),
    )


def _greys(image: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Grey values (m,), 0..1, of an image's m `seen` pixels: the mean of the three colours."""
    return image[seen].mean(axis=-1) / _TOP
