"""The pinhole camera: pixels to rays and back.

Camera frame: x right, y down, z forward. Pixel coordinates are (u, v), u to the right, with the
centre of the first pixel at (0, 0), as KITTI's `P_rect` has it.
"""

from dataclasses import dataclass

import numpy as np

from nvsf_core.errors import CalibrationError, ShapeError
from nvsf_core.geometry.intrinsics import intrinsics_fault


@dataclass(frozen=True, slots=True)
class Pinhole:
    """A rectified camera: u = fx x/z + cx, v = fy y/z + cy.

    Raises:
        CalibrationError: A value is not finite, or unphysical (see `intrinsics_fault`).
    """

    fx: float
    """Horizontal focal length, pixels."""
    fy: float
    """Vertical focal length, pixels."""
    cx: float
    """Column of the optical axis, pixels."""
    cy: float
    """Row of the optical axis, pixels."""
    width: int
    """Columns of the image."""
    height: int
    """Rows of the image."""

    def __post_init__(self) -> None:
        """Refuse what is no camera."""
        fault = intrinsics_fault((self.fx, self.fy), (self.cx, self.cy), (self.width, self.height))
        if fault is not None:
            raise CalibrationError(f"{fault}; check P_rect and S_rect")

    @property
    def matrix(self) -> np.ndarray:
        """The (3, 3) float64 intrinsic matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def pixels(self) -> np.ndarray:
        """Centres of all pixels, (height, width, 2) float64, as (u, v)."""
        rows, columns = np.mgrid[0 : self.height, 0 : self.width]
        return np.stack([columns, rows], axis=-1).astype(np.float64)

    def rays(self, pixels: np.ndarray) -> np.ndarray:
        """Unit directions in the camera frame through pixels.

        Args:
            pixels: (..., 2) as (u, v).

        Returns:
            (..., 3) float64, each of length 1 with z > 0.

        Raises:
            ShapeError: The last axis is not 2 long.
        """
        if pixels.shape[-1] != 2:
            raise ShapeError(f"expected pixels (..., 2), found {pixels.shape}")
        pixels = pixels.astype(np.float64)
        x = (pixels[..., 0] - self.cx) / self.fx
        y = (pixels[..., 1] - self.cy) / self.fy
        directions = np.stack([x, y, np.ones_like(x)], axis=-1)
        return np.asarray(directions / np.linalg.norm(directions, axis=-1, keepdims=True))

    def project(self, points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels of points in the camera frame.

        Args:
            points_m: (..., 3), metres.

        Returns:
            `pixels` (..., 2) float64, NaN for points that are not in front of the camera, and
            `inside` (...) bool: the point is in front and its pixel centre lies in the image.

        Raises:
            ShapeError: The last axis is not 3 long.
        """
        if points_m.shape[-1] != 3:
            raise ShapeError(f"expected points (..., 3), found {points_m.shape}")
        points_m = points_m.astype(np.float64)
        depth_m = points_m[..., 2]
        front = depth_m > 0
        divisor_m = np.where(front, depth_m, np.nan)
        pixels = np.stack(
            [
                self.fx * points_m[..., 0] / divisor_m + self.cx,
                self.fy * points_m[..., 1] / divisor_m + self.cy,
            ],
            axis=-1,
        )
        return pixels, front & contains(pixels, self.width, self.height)


def contains(pixels: np.ndarray, width: int, height: int) -> np.ndarray:
    """Which pixels (..., 2) round to one of the image's; NaN does not."""
    u, v = pixels[..., 0], pixels[..., 1]
    return np.asarray((u >= -0.5) & (u < width - 0.5) & (v >= -0.5) & (v < height - 0.5))
