"""The pinhole that a lens by OpenCV's models is rectified to: all its pixels are ones that the lens saw.

OpenCV finds one by undistorting the image's border, by an iteration that does not converge for wide lenses:
its pinhole then sees beyond the image, or past the place where the polynomial folds the plane. Where that is
so, the pinhole is found by the lens's own model, from rays to pixels.

Of a fisheye of more than 120 degrees OpenCV's pinhole spends nearly all its pixels on the border. Such a lens
is shown as KITTI-360's fisheyes are: 90 degrees about its axis, here along the shorter side.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from nvsf_core.errors import CalibrationError
from nvsf_core.geometry.pinhole import intrinsics_fault

_SLACK_PX = 1.0
"""So far outside the image OpenCV's own pinholes may read."""
_WIDEST_FISHEYE_DEG = 120.0
_WIDEST_SIDE_DEG = 80.0
"""No pinhole looks farther aside of its axis."""
_GRID = 65
"""Places along each side at which a rectangle of the plane is tried."""
_LEAST_AREA = 0.05
"""Nearer to a fold the distortion says little; a pinhole's outermost pixels stay this far from it."""
_HALVINGS = 20
_MOST_ZOOM = 4.0
"""Most by which a focal length grows; beyond it a distortion leaves nearly nothing of the image."""


@dataclass(frozen=True, slots=True, eq=False)
class DistortedLens:
    """A pinhole with OpenCV's polynomial distortion, or OpenCV's fisheye."""

    matrix: np.ndarray
    """(3, 3) of the recorded image."""
    distortion: np.ndarray
    """(8,) of the polynomial, (4,) of the fisheye; OpenCV's order."""
    size_px: tuple[int, int]
    """Columns and rows of the recorded image."""
    is_fisheye: bool
    """Whether it is OpenCV's fisheye."""

    def project(self, plane: np.ndarray) -> np.ndarray:
        """Pixels (n, 2) of places (n, 2) = (x / z, y / z) of the camera's normalised plane."""
        if self.is_fisheye:
            return np.asarray(cv2.fisheye.distortPoints(plane[None], self.matrix, self.distortion)[0])
        none = np.zeros(3)
        rays = np.column_stack([plane, np.ones(len(plane))])
        return np.asarray(cv2.projectPoints(rays, none, none, self.matrix, self.distortion)[0][:, 0])

    def maps(self, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Column and row, each (height, width) float32, that a pinhole (3, 3) of the same size reads."""
        find = cv2.fisheye.initUndistortRectifyMap if self.is_fisheye else cv2.initUndistortRectifyMap
        across, down = find(self.matrix, self.distortion, np.eye(3), seen, self.size_px, cv2.CV_32FC1)
        return across, down

    def opencv_pinhole(self) -> np.ndarray:
        """The (3, 3) matrix of the pinhole that OpenCV finds."""
        if self.is_fisheye:
            return np.asarray(
                cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(
                    self.matrix, self.distortion, self.size_px, np.eye(3), balance=0.0
                )
            )
        found, _ = cv2.getOptimalNewCameraMatrix(
            self.matrix, self.distortion, self.size_px, 0.0, self.size_px
        )
        return np.asarray(found)


def rectification(lens: DistortedLens) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """The (3, 3) matrix of a pinhole of the lens's size, and its maps for `cv2.remap`.

    Raises:
        CalibrationError: The lens saw no such view about its axis.
    """
    seen = lens.opencv_pinhole()
    if _is_usable(lens, seen):
        maps = lens.maps(seen)
        if _are_seen(*maps, lens.size_px, slack_px=_SLACK_PX, least_area=0.0):
            return seen, maps
    seen = _pinhole_of(_shrunk(lens, _view_90_deg(lens) if lens.is_fisheye else _extent(lens)), lens.size_px)
    zoom = max(seen[0, 0] / lens.matrix[0, 0], seen[1, 1] / lens.matrix[1, 1])
    maps = lens.maps(seen)
    is_seen = _are_seen(*maps, lens.size_px, slack_px=_SLACK_PX, least_area=0.0)
    if not is_seen or not zoom <= _MOST_ZOOM:
        raise CalibrationError(
            "distortion: expected one by which a pinhole about the optical axis sees a good part of the "
            "image, found none; check `distortion` and the axis"
        )
    return seen, maps


def _is_usable(lens: DistortedLens, seen: np.ndarray) -> bool:
    """Whether OpenCV's pinhole is a camera, and of a fisheye not too wide."""
    focal, axis = (seen[0, 0], seen[1, 1]), (seen[0, 2], seen[1, 2])
    if intrinsics_fault(focal, axis, lens.size_px) is not None:
        return False
    if not lens.is_fisheye:
        return True
    fields = (
        np.degrees(np.arctan(place / one) + np.arctan((side - 1 - place) / one))
        for one, place, side in zip(focal, axis, lens.size_px, strict=True)
    )
    return bool(max(fields) <= _WIDEST_FISHEYE_DEG)


def _are_seen(
    across: np.ndarray, down: np.ndarray, size_px: tuple[int, int], *, slack_px: float, least_area: float
) -> bool:
    """Whether all pixels that are read lie in the image, and nothing is mirrored.

    Past the place where a distortion folds the plane, what is farther out is read from farther in.

    Args:
        across: (h, w) columns that are read.
        down: (h, w) their rows.
        size_px: Columns and rows of the image.
        slack_px: So far outside it still counts as in it.
        least_area: Area of the image that a pixel covers, as a share of the largest; 0 at a fold.
    """
    width, height = size_px
    inside = (across >= -slack_px) & (across <= width - 1 + slack_px)
    inside &= (down >= -slack_px) & (down <= height - 1 + slack_px)
    if not inside.all():
        return False
    (u_down, u_right), (v_down, v_right) = np.gradient(across), np.gradient(down)
    area = u_right * v_down - u_down * v_right
    return bool((area > least_area * area.max()).all() and area.max() > 0.0)


def _extent(lens: DistortedLens) -> np.ndarray:
    """(left, top, right, bottom) of the plane, as far as the lens saw along its rows and columns' axes."""
    away = np.tan(np.radians(np.linspace(0.0, _WIDEST_SIDE_DEG, 4001)))
    found = []
    for direction in ((-1.0, 0.0), (0.0, -1.0), (1.0, 0.0), (0.0, 1.0)):
        pixel = lens.project(away[:, None] * np.array(direction))
        goes_on = np.diff(pixel @ np.array(direction), prepend=-np.inf) > 0.0
        inside = ((pixel >= 0.0) & (pixel <= np.array(lens.size_px) - 1.0)).all(axis=1)
        count = int(np.logical_and.accumulate(goes_on & inside).sum())
        found.append(sum(direction) * away[max(count - 1, 0)])
    return np.array(found)


def _view_90_deg(lens: DistortedLens) -> np.ndarray:
    """(left, top, right, bottom) of the plane: 90 degrees along the shorter side, with square pixels."""
    half = (np.array(lens.size_px) - 1.0) / (min(lens.size_px) - 1.0)
    return np.array([*-half, *half])


def _shrunk(lens: DistortedLens, rectangle: np.ndarray) -> np.ndarray:
    """The largest rectangle of the same shape about the axis all of which the lens saw."""

    def is_seen(share: float) -> bool:
        left, top, right, bottom = share * rectangle
        x, y = np.meshgrid(np.linspace(left, right, _GRID), np.linspace(top, bottom, _GRID))
        pixel = lens.project(np.column_stack([x.ravel(), y.ravel()])).reshape(_GRID, _GRID, 2)
        return _are_seen(pixel[..., 0], pixel[..., 1], lens.size_px, slack_px=0.0, least_area=_LEAST_AREA)

    low, high = 0.0, 1.0
    if is_seen(high):
        return rectangle
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if is_seen(middle) else (low, middle)
    return low * rectangle


def _pinhole_of(rectangle: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
    """The (3, 3) matrix of a pinhole whose outermost pixels look at a rectangle's sides."""
    left, top, right, bottom = rectangle
    focal = (np.array(size_px) - 1.0) / np.maximum([right - left, bottom - top], 1e-12)
    return np.array([[focal[0], 0.0, -left * focal[0]], [0.0, focal[1], -top * focal[1]], [0.0, 0.0, 1.0]])
