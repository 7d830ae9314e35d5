"""Oriented boxes as 4x4 transforms of the unit cube [-0.5, 0.5]^3; the 3x3 part holds the size."""

import numpy as np

from nvsf_core.errors import ShapeError
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.geometry.se3 import exp_so3, log_so3

CORNERS = np.array(np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [-0.5, 0.5], indexing="ij")).reshape(3, 8).T
"""(8, 3) corners of the unit cube."""
_HALF_TURN = np.array([-1.0, -1.0, 1.0, 1.0])
"""What a half turn of a box about its upright axis multiplies its columns by."""
_HARDLY_TURNED_RAD = 0.028
"""Axes that are less apart have a mean that is short by 1e-4 at most, 0.4 mm of a car."""


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


def box_between(before: np.ndarray, after: np.ndarray, share: float) -> np.ndarray:
    """The box (4, 4) at a share of the way from one box (4, 4) of an object to a later one.

    The middle and the edges' lengths change linearly, and the axes turn the shortest way at a constant rate,
    so a box between two is neither flat nor shrunk. A box that is turned by 180 degrees about its own upright
    (third) axis is the same box. So of two headings more than 90 degrees apart about that axis the later one
    is turned round: a label whose heading flips does not turn the object. At shares 0 and 1 the boxes are
    returned as they are; at shares beyond, the motion goes on.

    Raises:
        ShapeError: A box is not (4, 4), or is flat.
    """
    _require_boxes(before[None])
    _require_boxes(after[None])
    if share in (0.0, 1.0):
        return (before if share == 0.0 else after).copy()
    before, after = _right_handed(before), _right_handed(after)
    axes, later_axes = _axes(before), _axes(after)
    if np.trace(axes[:, :2].T @ later_axes[:, :2]) < 0.0:  # twice the cosine of the turn of the heading
        after, later_axes = after * _HALF_TURN, later_axes * _HALF_TURN[:3]
    between: np.ndarray = (1.0 - share) * before + share * after
    way_rad = log_so3(axes.T @ later_axes)
    if np.linalg.norm(way_rad) > _HARDLY_TURNED_RAD:
        # In its own axes a box is the lengths of its edges, and what shear it has.
        edges_m = (1.0 - share) * axes.T @ before[:3, :3] + share * later_axes.T @ after[:3, :3]
        between[:3, :3] = axes @ exp_so3(share * way_rad) @ edges_m
    return between


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


def _right_handed(box: np.ndarray) -> np.ndarray:
    """The same box (4, 4) with axes that can be turned to those of any other; a mirrored cube is a cube."""
    volume_m3 = np.linalg.det(box[:3, :3])
    if not np.abs(volume_m3) > 0.0:
        raise ShapeError(f"expected a box with a volume, found {box[:3, :3].tolist()}; drop that box")
    return np.asarray(box * [1.0, 1.0, np.sign(volume_m3), 1.0])


def _axes(box: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) nearest to a right-handed box's axes, which KITTI-360's boxes have sheared a little."""
    left, _, right = np.linalg.svd(box[:3, :3])
    return np.asarray(left @ right)
