import numpy as np
import pytest

from nvsf_core.errors import ShapeError
from nvsf_core.geometry.boxes import box_between, box_corners, box_rectangles, inside_any
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.geometry.se3 import exp_so3, rotation_of

FAR_M = np.array([1000.3, 3700.6, 115.2])
SIZE_M = np.array([4.0, 1.8, 1.5])


def _heading(yaw_deg: float, *, size_m: np.ndarray = SIZE_M, x_m: float = 0.0) -> np.ndarray:
    """A box (4, 4) on a slope, turned about its own upright axis."""
    box = np.eye(4)
    box[:3, :3] = rotation_of(10.0, 5.0, 3.0) @ rotation_of(yaw_deg, 0.0, 0.0) * size_m
    box[:3, 3] = FAR_M + np.array([x_m, 0.0, 0.0])
    return box


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


@pytest.mark.parametrize("share", [0.3, 0.5, 0.75, 1.4, -0.4])
@pytest.mark.parametrize(
    ("turn_deg", "way_deg"),
    [(0, 0), (15, 15), (60, 60), (-89, -89), (120, -60), (180, 0), (-179, 1), (359, -1)],
)
def test_a_box_between_two_keeps_its_size_and_turns_the_way_of_an_object(
    turn_deg: float, way_deg: float, share: float
) -> None:
    found = box_between(_heading(0.0), _heading(turn_deg, x_m=2.0), share)
    # Headings that are hardly apart are mixed, which is off by 1e-4 of an edge.
    np.testing.assert_allclose(found, _heading(share * way_deg, x_m=2.0 * share), atol=4.2e-4, rtol=0.0)
    mirror = np.array([1.0, -1.0, 1.0, 1.0])
    mirrored = box_between(_heading(0.0) * mirror, _heading(turn_deg, x_m=2.0) * mirror, share)
    points_m = (np.random.default_rng(0).uniform(-0.6, 0.6, (500, 3)) @ found[:3, :3].T) + found[:3, 3]
    assert np.array_equal(inside_any(points_m, mirrored[None]), inside_any(points_m, found[None]))


def test_between_boxes_of_one_orientation_all_is_linear_bit_by_bit_and_at_the_ends_they_are_themselves() -> (
    None
):
    before, after = _heading(30.0), _heading(30.0, size_m=np.array([4.4, 1.6, 1.5]), x_m=1.0)
    assert np.array_equal(box_between(before, after, 0.3), (1.0 - 0.3) * before + 0.3 * after)
    turned = _heading(210.0, size_m=np.array([4.4, 1.6, 1.5]))
    assert np.array_equal(box_between(before, turned, 0.0), before)
    assert np.array_equal(box_between(before, turned, 1.0), turned)
    edges_m = np.linalg.norm(box_between(before, turned, 0.5)[:3, :3], axis=0)
    assert edges_m == pytest.approx([4.2, 1.7, 1.5])


def test_a_sheared_box_keeps_its_shear_on_the_way() -> None:
    shear = np.eye(3)
    shear[0, 1] = 0.05
    before, after = _heading(0.0), _heading(80.0)
    before[:3, :3] = before[:3, :3] @ shear
    after[:3, :3] = after[:3, :3] @ shear
    between = box_between(before, after, 0.5)[:3, :3]
    np.testing.assert_allclose(between.T @ between, before[:3, :3].T @ before[:3, :3], atol=1e-9)


def test_no_box_is_between_one_and_a_flat_one() -> None:
    with pytest.raises(ShapeError, match="volume"):
        box_between(_heading(0.0), _heading(0.0, size_m=np.array([4.0, 0.0, 1.5])), 0.5)
