"""The MEI (unified) model of a fisheye camera: project, and unproject by Newton's method.

With the unit vector (x, y, z) to a point, camera frame x right, y down, z forward:

    m = (x, y) / (z + xi),  r2 = |m|^2
    d = m (1 + k1 r2 + k2 r2^2) + (2 p1 mx my + p2 (r2 + 2 mx^2), p1 (r2 + 2 my^2) + 2 p2 mx my)
    u = gamma1 dx + u0,  v = gamma2 dy + v0

C. Mei, P. Rives, "Single View Point Omnidirectional Camera Calibration from Planar Grids", ICRA 2007.
"""

import math
from dataclasses import dataclass

import numpy as np

from nvsf_core.errors import CalibrationError, ShapeError
from nvsf_core.geometry.pinhole import Pinhole, contains, intrinsics_fault

_MOST_DISTORTION = 100.0
"""Largest distortion coefficient; those of real lenses are below 10."""
_NEWTON_STEPS = 12
_NEWTON_RESIDUAL = 1e-9
"""Largest error of a solution, in units of the normalised plane."""
_LARGEST_VIEW_PX = 1000
"""A 90 degree view of KITTI-360's fisheye is 840 pixels wide at the lens's central resolution."""


@dataclass(frozen=True, slots=True)
class MeiFisheye:
    """A fisheye camera by KITTI-360's `image_02.yaml` and `image_03.yaml`.

    Raises:
        CalibrationError: A value is not finite, or unphysical (see `intrinsics_fault`).
    """

    xi: float
    """Distance of the projection centre from the centre of the unit sphere."""
    k1: float
    """Radial distortion, second order."""
    k2: float
    """Radial distortion, fourth order."""
    p1: float
    """Tangential distortion."""
    p2: float
    """Tangential distortion."""
    gamma1: float
    """Horizontal scale, pixels."""
    gamma2: float
    """Vertical scale, pixels."""
    u0: float
    """Column of the optical axis, pixels."""
    v0: float
    """Row of the optical axis, pixels."""
    width: int
    height: int

    def __post_init__(self) -> None:
        """Refuse unphysical values."""
        lens = (self.xi, self.k1, self.k2, self.p1, self.p2)
        # NaN compares false.
        if not (self.xi >= 0.0 and all(abs(value) <= _MOST_DISTORTION for value in lens)):
            raise CalibrationError(
                f"expected xi >= 0 and xi, k1, k2, p1, p2 within +-{_MOST_DISTORTION:g}, found {lens}; "
                "check the camera's yaml"
            )
        fault = intrinsics_fault((self.gamma1, self.gamma2), (self.u0, self.v0), (self.width, self.height))
        if fault is not None:
            raise CalibrationError(f"{fault} (gamma1 and gamma2, u0 and v0); check the camera's yaml")

    @property
    def matrix(self) -> np.ndarray:
        """The (3, 3) float64 matrix from the distorted normalised plane to pixels."""
        return np.array([[self.gamma1, 0.0, self.u0], [0.0, self.gamma2, self.v0], [0.0, 0.0, 1.0]])

    @property
    def as_pinhole(self) -> Pinhole | None:
        """The same camera as a pinhole, where it is one: xi = 0 and no distortion."""
        if any((self.xi, self.k1, self.k2, self.p1, self.p2)):
            return None
        return Pinhole(
            fx=self.gamma1, fy=self.gamma2, cx=self.u0, cy=self.v0, width=self.width, height=self.height
        )

    @property
    def distortion(self) -> np.ndarray:
        """(4,) float64: k1, k2, p1, p2."""
        return np.array([self.k1, self.k2, self.p1, self.p2])

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels of points (or directions) in the camera frame.

        Args:
            points: (..., 3), any length.

        Returns:
            `pixels` (..., 2) float64, NaN where the model has no image of the point, and `inside`
            (...) bool: it has one and that lies in the image. Directions beyond 90 degrees are imaged
            as far as the model is one to one: cos(angle) > -1/xi (for xi < 1: > -xi).

        Raises:
            ShapeError: The last axis is not 3 long.
        """
        if points.shape[-1] != 3:
            raise ShapeError(f"expected points (..., 3), found {points.shape}")
        points = points.astype(np.float64)
        length = np.linalg.norm(points, axis=-1)
        unit = points / np.where(length > 0, length, np.nan)[..., None]
        limit = -1.0 / self.xi if self.xi > 1 else -self.xi
        imaged = unit[..., 2] > limit
        divisor = np.where(imaged, unit[..., 2] + self.xi, np.nan)
        distorted = self._distort(unit[..., :2] / divisor[..., None])
        pixels = distorted * (self.gamma1, self.gamma2) + (self.u0, self.v0)
        return pixels, imaged & contains(pixels, self.width, self.height)

    def unproject(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Unit directions in the camera frame through pixels.

        Args:
            pixels: (..., 2) as (u, v).

        Returns:
            `directions` (..., 3) float64, NaN where no direction has this pixel as its image, and
            `solved` (...) bool.

        Raises:
            ShapeError: The last axis is not 2 long.
        """
        if pixels.shape[-1] != 2:
            raise ShapeError(f"expected pixels (..., 2), found {pixels.shape}")
        target = (pixels.astype(np.float64) - (self.u0, self.v0)) / (self.gamma1, self.gamma2)
        plane = target.copy()
        # Pixels far outside the image may diverge and overflow: they end as not solved.
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            for _ in range(_NEWTON_STEPS):
                plane = plane - self._newton_step(plane, self._distort(plane) - target)
            residual = np.linalg.norm(self._distort(plane) - target, axis=-1)
            r2 = np.sum(plane**2, axis=-1)
            discriminant = 1.0 + (1.0 - self.xi**2) * r2
            solved = (residual < _NEWTON_RESIDUAL) & (discriminant >= 0.0)
            scale = (self.xi + np.sqrt(np.where(solved, discriminant, np.nan))) / (1.0 + r2)
            directions = np.concatenate([plane * scale[..., None], (scale - self.xi)[..., None]], axis=-1)
        return directions, np.asarray(solved)

    def _distort(self, plane: np.ndarray) -> np.ndarray:
        x, y = plane[..., 0], plane[..., 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (self.k1 + self.k2 * r2)
        dx = 2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x * x)
        dy = self.p1 * (r2 + 2.0 * y * y) + 2.0 * self.p2 * x * y
        return np.stack([x * radial + dx, y * radial + dy], axis=-1)

    def _newton_step(self, plane: np.ndarray, residual: np.ndarray) -> np.ndarray:
        """Solve the 2x2 system J step = residual, J the derivative of the distortion."""
        x, y = plane[..., 0], plane[..., 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (self.k1 + self.k2 * r2)
        slope = 2.0 * (self.k1 + 2.0 * self.k2 * r2)
        j_xx = radial + slope * x * x + 2.0 * self.p1 * y + 6.0 * self.p2 * x
        j_yy = radial + slope * y * y + 6.0 * self.p1 * y + 2.0 * self.p2 * x
        j_xy = slope * x * y + 2.0 * self.p1 * x + 2.0 * self.p2 * y
        determinant = j_xx * j_yy - j_xy * j_xy
        step_x = (j_yy * residual[..., 0] - j_xy * residual[..., 1]) / determinant
        step_y = (j_xx * residual[..., 1] - j_xy * residual[..., 0]) / determinant
        return np.stack([step_x, step_y], axis=-1)


def shown_as(lens: Pinhole | MeiFisheye) -> Pinhole:
    """The pinhole that a recorded camera's images are shown as; itself if it has no distortion."""
    if isinstance(lens, Pinhole):
        return lens
    return lens.as_pinhole or perspective_view(lens)


def perspective_view(fisheye: MeiFisheye) -> Pinhole:
    """The square view of 90 degrees that a fisheye is undistorted to: as high as it, at most 1000 pixels."""
    size = min(fisheye.height, _LARGEST_VIEW_PX)
    focal = 0.5 * size / math.tan(math.radians(45.0))
    centre = 0.5 * (size - 1)
    return Pinhole(fx=focal, fy=focal, cx=centre, cy=centre, width=size, height=size)
