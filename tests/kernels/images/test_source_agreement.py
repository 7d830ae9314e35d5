"""Source images that differ from the others over an area lose weight; those that differ in pixels do not."""

import numpy as np

from nvsf_core.kernels.images.source_agreement import source_trust

SOURCES, DEPTHS, ROWS, COLUMNS = 3, 2, 40, 60
LIKELIEST = np.zeros((ROWS, COLUMNS), np.int64)
AROUND = np.full((3, ROWS, COLUMNS), 0.5, np.float32)
WEIGHT = np.ones(SOURCES, np.float32)


def grey() -> tuple[np.ndarray, np.ndarray]:
    """Colours (k, 3, d, h, w) that are .5 everywhere, all shown (k, d, h, w)."""
    colour = np.full((SOURCES, 3, DEPTHS, ROWS, COLUMNS), 0.5, np.float32)
    return colour, np.ones((SOURCES, DEPTHS, ROWS, COLUMNS), np.bool_)


def trust(colour: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """(d, k, h, w) of the sources' colours, without the rim."""
    found = source_trust(colour, seen, LIKELIEST, AROUND, WEIGHT)
    return found[:-1].reshape(DEPTHS, SOURCES, ROWS, COLUMNS)[..., 5:-5, 5:-5]


def test_sources_that_agree_keep_all_of_their_weight() -> None:
    assert (trust(*grey()) == 1.0).all()


def test_a_source_that_shows_another_surface_loses_most_of_it() -> None:
    colour, seen = grey()
    colour[2, :, :, :, 30:] = 0.9
    found = trust(colour, seen)
    # The mean of the three is off by a third of the difference, and a twentieth of it is the colour around.
    odd, others = found[:, 2, :, 32:], found[:, :2, :, 32:]
    np.testing.assert_allclose(odd, 1.0 / (1.0 + (0.4 - 0.4 / 3.05) ** 2 / 0.01), rtol=1e-3)
    assert others.min() > 0.3 > 0.2 > odd.max()
    assert (found[:, :, :, :20] == 1.0).all()


def test_a_source_is_judged_at_each_of_its_depths() -> None:
    colour, seen = grey()
    colour[1, :, 1] = 0.9
    found = trust(colour, seen)
    assert (found[0] == 1.0).all() and (found[1, [0, 2]] == 1.0).all()
    np.testing.assert_allclose(found[1, 1], 1.0 / 17.0, rtol=1e-3)


def test_texture_a_pixel_aside_is_no_other_surface() -> None:
    colour, seen = grey()
    colour[0] += 0.2 * (-1.0) ** np.arange(COLUMNS, dtype=np.float32)
    colour[1] -= 0.2 * (-1.0) ** np.arange(COLUMNS, dtype=np.float32)
    assert trust(colour, seen).min() > 0.9


def test_beside_what_a_source_does_not_show_it_has_less_weight() -> None:
    colour, seen = grey()
    seen[0, :, :, 30:] = False
    colour[0, :, :, :, 30:] = np.nan
    found = trust(colour, seen)[:, 0]
    assert np.isfinite(found).all()
    assert (np.diff(found[:, :, 15:25]) <= 0.0).all() and (found[:, :, :20] == 1.0).all()
    np.testing.assert_allclose(found[:, :, 24], 5.0 / 9.0, rtol=1e-5)


def test_the_colour_around_is_compared_too() -> None:
    colour, seen = grey()
    around = np.full((3, ROWS, COLUMNS), 0.9, np.float32)
    found = source_trust(colour, seen, LIKELIEST, around, WEIGHT)[-1, 5:-5, 5:-5]
    np.testing.assert_allclose(found, 1.0 / (1.0 + (0.4 * 3.0 / 3.05) ** 2 / 0.01), rtol=1e-3)


def test_the_smallest_windows_pass() -> None:
    colour, seen = grey()
    small = source_trust(
        np.ascontiguousarray(colour[..., :2, :2]), np.ascontiguousarray(seen[..., :2, :2]),
        LIKELIEST[:2, :2].copy(), AROUND[:, :2, :2].copy(), WEIGHT,
    )  # fmt: skip
    assert small.shape == (DEPTHS * SOURCES + 1, 2, 2) and np.isfinite(small).all() and (small > 0.0).all()
