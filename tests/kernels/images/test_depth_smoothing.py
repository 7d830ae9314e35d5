"""Single pixels of another depth than most around them take that of those; surfaces lose their noise."""

import numpy as np

from nvsf_core.kernels.images.depth_smoothing import smoothed

SHAPE = (24, 40)
STATIC = np.zeros(SHAPE, np.uint8)


def road() -> np.ndarray:
    """A slanted surface, inverse depths in 1/m."""
    return np.tile(np.linspace(0.1, 0.13, SHAPE[0], dtype=np.float32)[:, None], (1, SHAPE[1]))


def test_a_surface_and_a_straight_edge_stay() -> None:
    edge = road()
    edge[:, 17:] = 0.5
    for inverse in (road(), edge):
        found, is_other = smoothed(inverse, STATIC)
        np.testing.assert_allclose(found, inverse, rtol=1e-6)
        assert not is_other.any()


def test_single_pixels_and_pairs_take_the_depth_around_them() -> None:
    inverse = road()
    inverse[10, 10], inverse[15, 20:22], inverse[5, 39] = 0.4, 0.001, 0.4
    found, changed = smoothed(inverse, STATIC)
    assert (np.abs(found - road()) <= 0.03 * road()).all()
    assert changed.sum() == 4 and changed[10, 10] and changed[15, 20:22].all() and changed[5, 39]


def test_a_pole_three_pixels_wide_stays() -> None:
    inverse = road()
    inverse[:, 20:23] = 0.5
    np.testing.assert_allclose(smoothed(inverse, STATIC)[0], inverse, rtol=1e-6)


def test_what_shows_another_object_is_not_compared() -> None:
    inverse, label = road(), STATIC.copy()
    inverse[8:12, 8:10], label[8:12, 8:10] = 0.5, 1
    np.testing.assert_allclose(smoothed(inverse, label)[0], inverse, rtol=1e-6)


def test_noise_of_a_surface_is_averaged_and_an_edge_stays_sharp() -> None:
    truth = road()
    truth[:, 17:] = 0.5
    noise = np.random.default_rng(0).normal(0.0, 0.01, SHAPE).astype(np.float32)
    found, _ = smoothed(truth * (1.0 + noise), STATIC)
    errors = np.abs(found / truth - 1.0)
    assert errors.mean() < 0.4 * np.abs(noise).mean()
    assert errors[:, 15:19].max() < 0.03


def test_surfaces_of_two_objects_close_together_are_not_averaged() -> None:
    inverse, label = road(), STATIC.copy()
    inverse[:, 20:], label[:, 20:] = 1.03 * inverse[:, 20:], 1
    np.testing.assert_allclose(smoothed(inverse, label)[0], inverse, rtol=1e-6)
