"""Laws of depth maps that are carried into another view."""

import numpy as np

from nvsf_core.kernels.images.depth_splat import agreed_depths, splat_depth_map, without_edges

INTRINSICS = (40.0, 40.0, 31.5, 15.5)
SHAPE = (32, 64)
STILL = np.eye(4)[None]
NOTHING_MOVES = np.zeros(SHAPE, np.uint8)


def moved(x_m: float = 0.0, z_m: float = 0.0) -> np.ndarray:
    motion = np.eye(4)
    motion[0, 3], motion[2, 3] = x_m, z_m
    return motion[None]


def test_a_view_from_the_same_place_sees_the_map_itself() -> None:
    inverse = np.random.default_rng(0).uniform(0.05, 0.3, SHAPE).astype(np.float32)
    view, _ = splat_depth_map(inverse, NOTHING_MOVES, STILL, INTRINSICS)
    np.testing.assert_allclose(view, inverse, rtol=1e-6)


def test_a_wall_gets_nearer_without_cracks_when_the_view_moves_towards_it() -> None:
    wall = np.full(SHAPE, 1.0 / 12.0, np.float32)
    view, _ = splat_depth_map(wall, NOTHING_MOVES, moved(z_m=-6.0), INTRINSICS)
    np.testing.assert_allclose(view, 1.0 / 6.0, rtol=1e-5)


def test_what_is_in_front_hides_what_is_behind_and_uncovers_what_nothing_shows() -> None:
    inverse = np.full(SHAPE, 1.0 / 20.0, np.float32)
    inverse[8:24, 24:40] = 1.0 / 4.0
    # 1 m to the left of the image: the near square moves 10 px to the right, the wall 2 px.
    view, _ = splat_depth_map(inverse, NOTHING_MOVES, moved(x_m=1.0), INTRINSICS)
    assert (view[10:22, 36:48] > 0.24).all()
    assert (view[10:22, 27:33] == 0.0).all(), "behind the square nothing was seen"
    assert (view[0:6, 4:] > 0.04).all()


def test_what_moves_is_where_it_is_at_the_views_instant_and_absent_where_that_is_unknown() -> None:
    inverse = np.full(SHAPE, 1.0 / 20.0, np.float32)
    inverse[8:24, 24:40] = 1.0 / 4.0
    label = np.zeros(SHAPE, np.uint8)
    label[8:24, 24:40] = 1
    there, labels = splat_depth_map(inverse, label, np.concatenate([STILL, moved(x_m=0.5)]), INTRINSICS)
    assert (there[10:22, 30:44] > 0.24).all() and (labels[10:22, 30:44] == 1).all()
    gone, labels = splat_depth_map(inverse, label, np.stack([np.eye(4), np.zeros((4, 4))]), INTRINSICS)
    assert gone.max() < 0.06 and (labels == 0).all()


def agreed(
    *values: float, weight: tuple[float, ...] = (), label: tuple[int, ...] = (), expected: int = 0
) -> tuple[float, ...]:
    """Depth and support of both surfaces at the one pixel of maps with these inverse depths."""
    inverse = np.array(values, np.float32)[:, None, None]
    labels = np.array(label or (0,) * len(values), np.uint8)[:, None, None]
    weights = np.tile(np.array(weight or (1.0,) * len(values), np.float32), (3, 1))
    there = np.full((1, 1), expected, np.uint8)
    depth, support, _ = agreed_depths(inverse, labels, weights, 0.3, there)
    return (*depth[:, 0, 0].tolist(), *support[:, 0, 0].tolist())


def test_the_nearest_depth_with_enough_support_is_the_front_and_the_best_other_one_comes_second() -> None:
    front, other, share, other_share = agreed(0.30, 0.10, 0.1005, 0.05, 0.0501, 0.0502, 0.0502)
    # One map of seven says 0.30: passed over. Two say 0.10, which is not 30 % either; four say 0.05.
    assert abs(front - 0.0501) < 1e-3 and abs(share - 4 / 7) < 1e-6
    assert abs(other - 0.10025) < 1e-3 and abs(other_share - 2 / 7) < 1e-6


def test_two_of_four_maps_are_enough_to_hide_what_the_others_see() -> None:
    front, other, *_ = agreed(0.2, 0.201, 0.05, 0.0501)
    assert abs(front - 0.2005) < 1e-3 and abs(other - 0.05) < 1e-3


def test_where_nothing_is_agreed_the_heaviest_map_is_believed_and_unknown_ones_count_for_nothing() -> None:
    front, _, share, _ = agreed(0.0, 0.3, 0.2, 0.1, 0.05, weight=(9.0, 1.0, 1.0, 1.2, 1.0))
    assert abs(front - 0.1) < 1e-6 and abs(share - 1.2 / 13.2) < 1e-6
    assert agreed(0.0, 0.0) == (0.0, 0.0, 0.0, 0.0)


def test_unlike_things_at_one_depth_do_not_agree() -> None:
    _, other, share, _ = agreed(0.1, 0.1, 0.1, label=(0, 1, 0))
    assert abs(share - 2 / 3) < 1e-6 and abs(other - 0.1) < 1e-6


def test_pixels_on_both_sides_of_an_edge_are_unknown_and_slopes_are_none() -> None:
    inverse = np.tile(np.linspace(0.1, 0.2, 64, dtype=np.float32), (32, 1))
    assert (without_edges(inverse) == inverse).all()
    inverse[:, 40:] = 0.02
    kept = without_edges(inverse)
    assert (kept[:, 39:41] == 0.0).all() and (kept[:, :39] == inverse[:, :39]).all()
    assert (kept[:, 41:] == inverse[:, 41:]).all()


def test_where_a_moving_object_is_expected_maps_that_show_what_was_there_before_do_not_hide_it() -> None:
    # One map of five has seen the object that is there now; the others show the street without it.
    before = (0.2, 0.1, 0.1, 0.1, 0.1)
    assert abs(agreed(*before, label=(2, 0, 0, 0, 0))[0] - 0.1) < 1e-6
    front, other, share, other_share = agreed(*before, label=(2, 0, 0, 0, 0), expected=2)
    assert abs(front - 0.2) < 1e-6 and abs(share - 0.2) < 1e-6 and (other, other_share) == (0.0, 0.0)
    # No map has seen that one: what they show stays.
    assert abs(agreed(*before, label=(2, 0, 0, 0, 0), expected=1)[0] - 0.1) < 1e-6


def test_a_map_has_a_weight_of_its_own_for_each_label() -> None:
    inverse = np.array([0.2, 0.1], np.float32)[:, None, None]
    weight = np.array([[1.0, 2.0], [3.0, 1.0]], np.float32)
    for label, depth, share in ((0, 0.1, 2 / 3), (1, 0.2, 3 / 4)):
        labels = np.full((2, 1, 1), label, np.uint8)
        found, support, _ = agreed_depths(inverse, labels, weight, 0.5, np.zeros((1, 1), np.uint8))
        assert abs(found[0, 0, 0] - depth) < 1e-6 and abs(support[0, 0, 0] - share) < 1e-6


def test_a_moving_object_is_believed_by_the_maps_nearest_to_it_whatever_others_show_of_the_street() -> None:
    inverse = np.array([0.2, 0.2, 0.1, 0.1, 0.1, 0.1, 0.1], np.float32)[:, None, None]
    weight = np.array([[0.1, 0.1, 1.0, 1.0, 1.0, 1.0, 1.0], [2.0, 1.0, 1.0, 0.1, 0.1, 0.1, 0.1]], np.float32)
    nothing = np.zeros((1, 1), np.uint8)

    def front(*label: int) -> tuple[float, int]:
        labels = np.array(label, np.uint8)[:, None, None]
        depth, _, found = agreed_depths(inverse, labels, weight, 0.8, nothing)
        return round(float(depth[0, 0, 0]), 6), int(found[0, 0, 0])

    assert front(1, 1, 0, 0, 0, 0, 0) == (0.2, 1), "three of the four that weigh most for it"
    assert front(0, 1, 0, 0, 0, 0, 0) == (0.1, 0), "one of the four"
    assert front(0, 0, 0, 0, 0, 0, 0) == (0.1, 0)
