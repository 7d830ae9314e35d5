"""What a camera's images look like as a whole: how far their grey values deviate, and how they are spread.

A rendered image is held against the training images of its camera, and only against those. As with scans
(`scan_norms`), it is doubted where it is nearer to knowing nothing, one grey all over, than to a recording.
"""

from dataclasses import dataclass

import numpy as np

from nvsf_core.errors import DataError
from nvsf_core.metrics.scan_norms import intensity_spread, spread_distance, spread_limit

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
