"""Fisheye images as a perspective view, through OpenCV's omnidirectional module.

The view looks along the fisheye's own optical axis, so both have the same pose.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from nvsf_core.errors import ShapeError
from nvsf_core.geometry.fisheye import MeiFisheye
from nvsf_core.geometry.pinhole import Pinhole


@dataclass(frozen=True, slots=True)
class Undistorter:
    """The resampling map of one camera, computed once for all its images."""

    fisheye: MeiFisheye
    view: Pinhole
    map_u: np.ndarray
    """(H, W) float32: column of the source that each pixel shows."""
    map_v: np.ndarray
    """(H, W) float32: its row."""
    valid: np.ndarray
    """(H, W) bool: the source has all four pixels that it is interpolated from."""

    def apply(self, image: np.ndarray) -> np.ndarray:
        """Resample one (h, w, 3) uint8 image bilinearly; invalid pixels become black.

        Raises:
            ShapeError: The image has not the fisheye's size.
        """
        expected = (self.fisheye.height, self.fisheye.width, 3)
        if image.shape != expected:
            raise ShapeError(f"expected an image {expected} as the calibration says, found {image.shape}")
        resampled = cv2.remap(image, self.map_u, self.map_v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        return np.where(self.valid[..., None], resampled, np.uint8(0))

    def apply_mask(self, mask: np.ndarray) -> np.ndarray:
        """Resample an (h, w) bool mask of the source: true where all interpolated pixels are true."""
        share = cv2.remap(mask.astype(np.float32), self.map_u, self.map_v, cv2.INTER_LINEAR)
        return np.asarray(self.valid & (share > 0.999))


def make_undistorter(fisheye: MeiFisheye, view: Pinhole) -> Undistorter:
    """Compute the map from `view` to `fisheye` with `cv2.omnidir.initUndistortRectifyMap`."""
    map_u, map_v = cv2.omnidir.initUndistortRectifyMap(
        fisheye.matrix,
        fisheye.distortion,
        np.array([fisheye.xi]),
        np.eye(3),
        view.matrix,
        (view.width, view.height),
        cv2.CV_32FC1,
        cv2.omnidir.RECTIFY_PERSPECTIVE,
    )
    valid = (map_u >= 0.0) & (map_u <= fisheye.width - 1.0) & (map_v >= 0.0) & (map_v <= fisheye.height - 1.0)
    return Undistorter(fisheye=fisheye, view=view, map_u=map_u, map_v=map_v, valid=valid)
