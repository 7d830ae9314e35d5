"""What scans and images of a drive look like as a whole: share of returns, intensity, brightness.

A rendered scan is compared with the training scans nearest in time; limits come from training scans alone.
There are two ways to know nothing: every ray returns (or none), and every intensity is the median. A
rendered scan is doubted when it is nearer to that than to the recording, that is beyond half the way. It may
differ as much as training scans of one drive differ from each other, and by what the sensor rounds away.
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


LEAST_LEVELS = 8.0
"""An image that deviates less from its mean is met by one grey with 30 dB: errors in it say nothing."""
_HALF = 0.5
_TOP = 255.0
_ENOUGH_PX = 40_000


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageNorms:
    """The training images of one camera, n of them."""

    seen: np.ndarray
    """(H, W) bool, the pixels that are looked at."""
    deviation: np.ndarray
    """(n,) standard deviation of each image's grey values, levels of 255."""
    spread: np.ndarray
    """(n, 101) of the grey values, as of `intensity_spread`."""

    @property
    def blank_below(self) -> float:
        """Levels that an image which is not blank deviates by: half of the plainest training image's."""
        return max(LEAST_LEVELS, _HALF * float(self.deviation.min()))

    @property
    def greys_limit(self) -> float:
        """How far a rendered image's grey values may be spread from the training image most like it."""
        return spread_limit(self.spread)

    def deviation_of(self, image: np.ndarray) -> float:
        """Standard deviation of an image's (H, W, 3) uint8 grey values, levels of 255."""
        return float(_greys(image, self.seen).std()) * _TOP

    def greys_apart(self, image: np.ndarray) -> float:
        """Distance of an image's (H, W, 3) uint8 greys from those of the training image most like it."""
        own = intensity_spread(_greys(image, self.seen))
        return min(spread_distance(own, recorded) for recorded in self.spread)


def image_norms(images: np.ndarray, valid: np.ndarray) -> ImageNorms:
    """The norms of a camera's training images.

    Args:
        images: (n, H, W, 3) uint8, n > 0.
        valid: (H, W) bool, the pixels that show something. Of many, evenly spaced ones are enough.

    Raises:
        DataError: There is no image, or no pixel that shows something.
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
    """Mean of the three colours, 0..1, of the pixels (m,) that are looked at."""
    grey: np.ndarray = image[seen].mean(axis=-1) / _TOP
    return grey
