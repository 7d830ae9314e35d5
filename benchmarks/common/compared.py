"""The fixed part of scans and images for quick scores: every fourth column of the pano, averaged pixels."""

from dataclasses import dataclass

import numpy as np

from nvsf_core.metrics.protocols import PanoImage, Scan
from nvsf_core.recording.drive import LidarRecording
from nvsf_core.sensors.linear_pano import LinearPano

SHARE = 4
"""One of so many blocks of columns is compared."""


@dataclass(frozen=True, slots=True)
class QuarterPano(LinearPano):
    """Every fourth block of columns of the pano."""

    block: int = 1
    """Columns of a block."""

    @property
    def columns(self) -> np.ndarray:
        """Those of the whole pano that are looked at."""
        return np.flatnonzero(np.arange(self.width) // self.block % SHARE == 0)

    def directions(self) -> np.ndarray:
        """(H, columns, 3) unit directions."""
        return LinearPano.directions(self)[:, self.columns]

    def points(self, range_m: np.ndarray) -> np.ndarray:
        """Points of the filled cells of an image (H, columns)."""
        filled = range_m > 0.0
        found: np.ndarray = self.directions()[filled] * range_m[filled, None].astype(np.float64)
        return found

    def cut(self, image: PanoImage) -> PanoImage:
        """The chosen columns of a whole pano."""
        return PanoImage(
            range_m=image.range_m[:, self.columns], intensity=image.intensity[:, self.columns],
            hit=image.hit[:, self.columns],
        )  # fmt: skip


def scan_of(lidar: LidarRecording, frame: int) -> int:
    """Which of all scans a frame's is."""
    return int(np.flatnonzero(lidar.sweeps.arrays["frame"] == frame)[0])


def recorded_scan(lidar: LidarRecording, frame: int) -> Scan:
    """A frame's scan as it was recorded."""
    a, part = lidar.sweeps.arrays, lidar.sweeps.returns_of(scan_of(lidar, frame))
    return Scan(points_m=a["points_m"][part], intensity=a["intensity"][part], laser=a["laser"][part])


def block_means(image: np.ndarray, side: int) -> np.ndarray:
    """Means of side x side pixels of an image (H, W, ...); a rest at the right and lower edge is left out."""
    height, width = (length // side for length in image.shape[:2])
    cut = image[: height * side, : width * side].astype(np.float64)
    found: np.ndarray = cut.reshape(height, side, width, side, *image.shape[2:]).mean(axis=(1, 3))
    return found


def block_colours(image: np.ndarray, side: int) -> np.ndarray:
    """The same of colours (H, W, 3), as (h, w, 3) uint8."""
    return np.rint(block_means(image, side)).astype(np.uint8)
