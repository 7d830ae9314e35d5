"""Oriented boxes as 4x4 transforms of the unit cube [-0.5, 0.5]^3; the 3x3 part holds the size."""

import numpy as np

from nvsf_core.errors import ShapeError
from nvsf_core.geometry.pinhole import Pinhole

CORNERS = np.array(np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [-0.5, 0.5], indexing="ij")).reshape(3, 8).T
"""(8, 3) corners of the unit cube."""


def box_corners(boxes: np.ndarray) -> np.ndarray:
    """Corners (B, 8, 3), metres, of boxes (B, 4, 4), in the frame that the boxes map to."""
    _require_boxes(boxes)
    return CORNERS @ np.moveaxis(boxes[:, :3, :3], 1, 2) + boxes[:, None, :3, 3]


def inside_any(points_m: np.ndarray, boxes: np.ndarray, grown_m: float = 0.0) -> np.ndarray:
    """Which points (N,) bool lie in at least one box, its surface included.

    Points (N, 3) are in the frame that the boxes (B, 4, 4) map the unit cube to, metres. Each box is grown by
    `grown_m` beyond each of its faces: a point p is inside if every coordinate of B^-1 p is at most 1/2 +
    grown / edge, the edge being the length of the box's column. A point that is not finite is in none.

    Raises:
        ShapeError: The arrays are not (N, 3) and (B, 4, 4), or a box is flat.
    """
    _require_boxes(boxes)
    if points_m.ndim != 2 or points_m.shape[1] != 3:
        raise ShapeError(f"expected points (N, 3), found {points_m.shape}")
    inside = np.zeros(len(points_m), dtype=bool)
    for box in boxes:
        edges_m = np.linalg.norm(box[:3, :3], axis=0)
        if not np.abs(np.linalg.det(box[:3, :3])) > 0.0:
            raise ShapeError(f"expected a box with a volume, found edges of {edges_m} m; drop that box")
        # Subtracting first keeps precision at world coordinates of several km.
        local = (points_m.astype(np.float64) - box[:3, 3]) @ np.linalg.inv(box[:3, :3]).T
        inside |= (np.abs(local) <= 0.5 + grown_m / edges_m).all(axis=1)
    return inside


def box_rectangles(camera: Pinhole, boxes_to_camera: np.ndarray) -> np.ndarray:
    """Pixels (height, width) bool inside the bounding rectangle of any box (B, 4, 4), unit cube to camera.

    A box counts if all its 8 corners are in front of the camera; occlusion is ignored.
    A pixel is inside when its centre is, borders included.
    """
    mask = np.zeros((camera.height, camera.width), dtype=bool)
    for corners_m in box_corners(boxes_to_camera):
        if not (corners_m[:, 2] > 0.0).all():
            continue
        pixels, _ = camera.project(corners_m)
        first = np.maximum(np.ceil(pixels.min(axis=0)), 0.0)
        last = np.minimum(np.floor(pixels.max(axis=0)), [camera.width - 1.0, camera.height - 1.0])
        if (last < first).any():
            continue
        (left, top), (right, bottom) = first.astype(np.int64), last.astype(np.int64)
        mask[top : bottom + 1, left : right + 1] = True
    return mask


def _require_boxes(boxes: np.ndarray) -> None:
    if boxes.ndim != 3 or boxes.shape[1:] != (4, 4):
        raise ShapeError(f"expected boxes (B, 4, 4), found {boxes.shape}")
