"""The pinhole camera: pixels to rays and back.

Camera frame: x right, y down, z forward. Pixel coordinates are (u, v), u to the right, with the
centre of the first pixel at (0, 0), as KITTI's `P_rect` has it.
"""

import math
from dataclasses import dataclass

import numpy as np

from nvsf_core.errors import CalibrationError, ShapeError


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
    height: int

    def __post_init__(self) -> None:
        """Refuse unphysical values."""
        fault = intrinsics_fault((self.fx, self.fy), (self.cx, self.cy), (self.width, self.height))
        if fault is not None:
            raise CalibrationError(fault)

    @property
    def matrix(self) -> np.ndarray:
        """The (3, 3) float64 intrinsic matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def pixels(self) -> np.ndarray:
        """Centres of all pixels, (height, width, 2) float64, as (u, v)."""
        rows, columns = np.mgrid[0 : self.height, 0 : self.width]
        return np.stack([columns, rows], axis=-1).astype(np.float64)

    def rays(self, pixels: np.ndarray) -> np.ndarray:
        """Unit directions (..., 3) float64, z > 0, in the camera frame through pixels (..., 2) as (u, v).

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
        """Pixels (..., 2) float64 of points (..., 3), metres, in the camera frame; NaN if not in front of it.

        And `inside` (...) bool: the point is in front and its pixel centre lies in the image.

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


FOCAL_WIDTHS = (0.05, 50.0)
"""Focal length over image width: from beyond any fisheye (0.05) to a telescope (50)."""
MOST_SIDE_PX = 16_384
LEAST_RECORDED_SIDE_PX = 8
"""Shortest side of a recorded image: colours and depths are taken between pixels, also of smaller copies."""
MOST_PIXELS = 64_000_000
"""Most pixels of an image: eight times a car camera's, so that a drive's images fit into memory."""
_MOST_ASPECT = 4.0
"""Largest ratio of the two focal lengths: pixels are square, or at most some times wider than high."""
_AXIS_SIDES = 1.0
"""How many image sides the optical axis may lie outside the image."""


def intrinsics_fault(
    focal_px: tuple[float, float], axis_px: tuple[float, float], size_px: tuple[float, float]
) -> str | None:
    """What is unphysical about a camera, all in pixels; None where nothing is.

    Focal lengths (or scales, of a fisheye) and size are horizontal, then vertical, the axis a column and a
    row. A focal length of 1e-300, for example, is positive and finite, but coordinates computed with it
    overflow.
    """
    if not all(map(math.isfinite, (*focal_px, *axis_px, *size_px))):
        return f"expected finite intrinsics, found focal {focal_px}, axis {axis_px}, size {size_px}"
    width, height = size_px
    whole = width == int(width) and height == int(height)
    if not whole or not 1 <= min(size_px) <= max(size_px) <= MOST_SIDE_PX or width * height > MOST_PIXELS:
        return (
            f"expected whole image sides from 1 to {MOST_SIDE_PX} pixels, at most {MOST_PIXELS:,} pixels "
            f"in all, found {width:g} x {height:g}"
        )
    least, most = (share * width for share in FOCAL_WIDTHS)
    if not all(least <= focal <= most for focal in focal_px):
        return (
            f"expected focal lengths of {FOCAL_WIDTHS[0]:g} to {FOCAL_WIDTHS[1]:g} image widths "
            f"({least:g} to {most:g} pixels), found {focal_px[0]:g} and {focal_px[1]:g}"
        )
    if max(focal_px) > _MOST_ASPECT * min(focal_px):
        return (
            f"expected pixels that are nearly square, found focal lengths {focal_px[0]:g} and {focal_px[1]:g}"
        )
    for place, side, word in zip(axis_px, size_px, ("column", "row"), strict=True):
        if not -_AXIS_SIDES * side <= place <= (1.0 + _AXIS_SIDES) * side:
            return (
                f"expected the optical axis near the image, found its {word} at {place:g} of {side:g} pixels"
            )
    return None


def recorded_size_fault(width: int, height: int) -> str | None:
    """What is wrong about the size of a recorded image; None where nothing is."""
    if min(width, height) >= LEAST_RECORDED_SIDE_PX:
        return None
    return (
        f"expected an image of at least {LEAST_RECORDED_SIDE_PX} x {LEAST_RECORDED_SIDE_PX} pixels, found "
        f"{width} x {height}; leave the camera out"
    )
