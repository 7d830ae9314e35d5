"""A camera of a drive: its training images with poses and times, and its mounting."""

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
    """(m,) int64: the valid pixels, as row * w + column."""

    @property
    def valid(self) -> np.ndarray:
        """(h, w) bool: pixels that show part of the recorded image."""
        mask = np.zeros(self.pinhole.height * self.pinhole.width, np.bool_)
        mask[self.pixel] = True
        return mask.reshape(self.pinhole.height, self.pinhole.width)


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraRecording:
    """One camera of the drive."""

    training: CameraImages
    """At least one image."""
    training_time_s: np.ndarray
    """(n,) instants of the training images, seconds since the first frame; an image may have a time of its
    own."""
    training_frame: np.ndarray
    """(n,) numbers of their frames: by them images of several cameras belong together."""
    recorded_frame: np.ndarray
    """(m,) frame numbers with an image, held-out ones included, ascending."""
    recorded_time_s: np.ndarray
    """(m,) instants of these images, likewise."""
    recorded_pose: np.ndarray
    """(m, 4, 4) float64 camera to scene-local at these instants."""
    in_lidar: np.ndarray
    """(4, 4) mounting: camera to the drive's LiDAR frame."""
