"""A camera of a drive: its training images, where and when they were taken, and how it is mounted."""

from dataclasses import dataclass

import numpy as np

from nvsf_core.geometry.pinhole import Pinhole


@dataclass(frozen=True, slots=True)
class CameraImages:
    """The training images of one camera."""

    pinhole: Pinhole
    rgb: np.ndarray
    """(n, h, w, 3) uint8."""
    pose: np.ndarray
    """(n, 4, 4) float64 camera to scene-local."""
    pixel: np.ndarray
    """(m,) int64: numbers row * w + column of the pixels that show anything."""

    @property
    def valid(self) -> np.ndarray:
        """(h, w) bool, the pixels that show anything."""
        mask = np.zeros(self.pinhole.height * self.pinhole.width, np.bool_)
        mask[self.pixel] = True
        return mask.reshape(self.pinhole.height, self.pinhole.width)


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraRecording:
    """One camera of the drive."""

    training: CameraImages
    """At least one image."""
    training_time_s: np.ndarray
    """(n,) of the training images."""
    recorded_frame: np.ndarray
    """(m,) frame numbers with an image, held-out ones included."""
    in_lidar: np.ndarray
    """(4, 4) camera to the drive's LiDAR frame: the mounting."""
