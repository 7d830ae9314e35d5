"""Returns of an image's own scan, which show where the same place is in the images around it.

The place of a scan's return in the image taken with the scan does not depend on the pose.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.geometry.se3 import invert_pose
from nvsf_core.rendering.reproject_camera import nearest_sources

_NEIGHBOURS = 4
_BLUR_PX = 1.5
"""Standard deviation of the smoothing. Slopes then point to the right place from about this far away."""
_CELL_PX, _MOST_RETURNS = 4, 12_000
_NEAREST_M = 0.5
_RIM_PX = 4


@dataclass(frozen=True, slots=True)
class Anchors:
    """Returns of a scan, in the frame of the camera whose image was taken with it."""

    point_m: np.ndarray
    """(m, 3) metres."""
    grey: np.ndarray
    """(m,) grey values of the image there, 0..1."""


def near_images(pose: np.ndarray, image: int) -> list[int]:
    """Indices of the images whose cameras were nearest to that of one image."""
    others = [index for index in range(len(pose)) if index != image]
    return [others[index] for index in nearest_sources(pose[image], pose[others], _NEIGHBOURS)]


def smoothed_grey(rgb: np.ndarray) -> np.ndarray:
    """(h, w) float32: smoothed grey values 0..1 of an image (h, w, 3) of levels 0..255."""
    return gaussian_filter(rgb.mean(axis=-1, dtype=np.float32) / 255.0, _BLUR_PX, mode="nearest")


def anchors_of(seen: np.ndarray, pinhole: Pinhole, pose: np.ndarray, returns_m: np.ndarray) -> Anchors:
    """Returns (m, 3), scene-local, that an image shows: the nearest in each small cell of the image."""
    inverse = invert_pose(pose)
    point = returns_m @ inverse[:3, :3].T + inverse[:3, 3]
    pixels, inside = projected(point, pinhole)
    point, pixels = point[inside], pixels[inside]
    column, row = (pixels // _CELL_PX).astype(np.int64).T
    cell = row * pinhole.width + column
    by_depth = np.argsort(point[:, 2], kind="stable")
    _, first = np.unique(cell[by_depth], return_index=True)
    kept = by_depth[first]
    kept = kept[:: max(1, -(-len(kept) // _MOST_RETURNS))]
    return Anchors(point[kept], levels_at(seen[:1], pixels[kept])[:, 0])


def projected(point: np.ndarray, pinhole: Pinhole) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (m, 2) of points (m, 3) in the camera's frame, and whether (m,) they are well in the image."""
    pixels, _ = pinhole.project(point)
    end = np.array([pinhole.width, pinhole.height]) - _RIM_PX - 0.5
    well = ((pixels > _RIM_PX - 0.5) & (pixels < end)).all(axis=1)
    return pixels, well & (point[:, 2] > _NEAREST_M)


def levels_at(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Values (m, c) of an image (c, h, w) at places (m, 2) between its pixels, bilinear."""
    places = pixels.T[::-1]
    return np.stack([map_coordinates(one, places, np.float64, order=1) for one in image], axis=1)
