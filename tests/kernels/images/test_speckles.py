"""Single pixels of another depth than most around them take that of those; surfaces stay as they are."""

import numpy as np

from nvsf_core.kernels.images.speckles import without_speckles

SHAPE = (24, 40)
STATIC = np.zeros(SHAPE, np.uint8)


def road() -> np.ndarray:
    """A slanted surface, inverse depths in 1/m."""
    return np.tile(np.linspace(0.1, 0.13, SHAPE[0], dtype=np.float32)[:, None], (1, SHAPE[1]))


def test_a_surface_and_a_straight_edge_stay() -> None:
    edge = road()
    edge[:, 17:] = 0.5
    for inverse in (road(), edge):
        assert np.array_equal(without_speckles(inverse, STATIC), inverse)


def test_single_pixels_and_pairs_take_the_depth_around_them() -> None:
    inverse = road()
    inverse[10, 10], inverse[15, 20:22], inverse[5, 39] = 0.4, 0.001, 0.4
    found = without_speckles(inverse, STATIC)
    assert (np.abs(found - road()) <= 0.03 * road()).all()
    changed = found != inverse
    assert changed.sum() == 4 and changed[10, 10] and changed[15, 20:22].all() and changed[5, 39]


def test_a_pole_three_pixels_wide_stays() -> None:
    inverse = road()
    inverse[:, 20:23] = 0.5
    assert np.array_equal(without_speckles(inverse, STATIC)[:, 21], inverse[:, 21])


def test_what_shows_another_object_is_not_compared() -> None:
    inverse, label = road(), STATIC.copy()
    inverse[8:12, 8:10], label[8:12, 8:10] = 0.5, 1
    assert np.array_equal(without_speckles(inverse, label), inverse)
