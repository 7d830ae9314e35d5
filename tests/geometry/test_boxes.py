import numpy as np
import pytest

from nvsf_core.errors import ShapeError
from nvsf_core.geometry.boxes import box_corners, box_rectangles, inside_any
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.geometry.se3 import exp_so3

FAR_M = np.array([1000.3, 3700.6, 115.2])
SIZE_M = np.array([4.0, 1.8, 1.5])


def _box(centre_m: np.ndarray = FAR_M) -> np.ndarray:
    box = np.eye(4)
    box[:3, :3] = exp_so3(np.array([0.1, -0.2, 0.7])) @ np.diag(SIZE_M)
    box[:3, 3] = centre_m
    return box[None]


def test_corners_are_half_an_edge_from_the_centre_along_each_axis() -> None:
    corners = box_corners(_box())[0]
    assert np.linalg.norm(corners - FAR_M, axis=1) == pytest.approx(np.linalg.norm(SIZE_M) / 2)
    assert corners.mean(axis=0) == pytest.approx(FAR_M)


def test_growing_adds_the_same_metres_beyond_every_face() -> None:
    turned = _box()[0, :3, :3] / SIZE_M
    for axis in range(3):
        for side in (-1.0, 1.0):
            face_m = FAR_M + side * turned[:, axis] * SIZE_M[axis] / 2
            beyond_m = face_m + side * turned[:, axis] * np.array([[-0.01], [0.01], [0.29], [0.31]])
            assert inside_any(beyond_m, _box()).tolist() == [True, False, False, False]
            assert inside_any(beyond_m, _box(), 0.3).tolist() == [True, True, True, False]


def test_a_point_in_either_of_two_boxes_is_inside_and_without_boxes_none_is() -> None:
    points = np.stack([FAR_M, FAR_M + 50.0, FAR_M + 90.0])
    both = np.concatenate([_box(), _box(FAR_M + 50.0)])
    assert inside_any(points, both).tolist() == [True, True, False]
    assert not inside_any(points, np.zeros((0, 4, 4))).any()
    assert not inside_any(np.full((1, 3), np.nan), both).any()


def test_a_flat_box_is_refused() -> None:
    flat = _box()
    flat[0, :3, 2] = 0.0
    with pytest.raises(ShapeError, match="volume"):
        inside_any(FAR_M[None], flat)


def test_a_rectangle_is_the_bounding_one_clipped_to_the_image() -> None:
    camera = Pinhole(fx=100.0, fy=100.0, cx=50.0, cy=40.0, width=101, height=81)
    box = np.diag([2.0, 1.0, 2.0, 1.0])[None].copy()
    box[0, 2, 3] = 6.0
    rows, columns = np.nonzero(box_rectangles(camera, box))
    # The near face, 5 m away, is the larger: 2 m are 40 pixels, 1 m is 20.
    assert (columns.min(), columns.max(), rows.min(), rows.max()) == (30, 70, 30, 50)
    assert len(rows) == 41 * 21
    box[0, 0, 3] = 2.5
    assert np.nonzero(box_rectangles(camera, box))[1].max() == 100
    box[0, 2, 3] = 0.5
    assert not box_rectangles(camera, box).any(), "a corner lies behind the camera"
