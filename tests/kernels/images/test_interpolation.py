"""Bicubic values between an image's pixels."""

import numpy as np
from numba import njit

from nvsf_core.kernels.images.interpolation import SHOWN, between, bicubic, corner, weights_of

HEIGHT, WIDTH = 12, 16
SIZE = (HEIGHT, WIDTH, 4)
ROW, COLUMN = np.mgrid[:HEIGHT, :WIDTH]
PLACES = 2.0 + np.random.default_rng(0).random((500, 2)) * (WIDTH - 5.0, HEIGHT - 5.0)
"""Column and row, at least two pixels away from the border."""


@njit
def _read(flat, size, places, is_cubic, found):  # type: ignore[no-untyped-def]
    for i in range(len(places)):
        u, v = np.float32(places[i, 0]), np.float32(places[i, 1])
        _, pixel, down, right = corner(size, u, v)
        beside, below = np.uint64(size[2]), np.uint64(size[1] * size[2])
        if is_cubic:
            found[i] = bicubic(flat, size, pixel, down, right)[0]
        else:
            weights = weights_of(down, right)
            found[i] = between(flat, pixel * beside, beside, below, np.uint64(0), weights)


def values(colour: np.ndarray, places: np.ndarray, *, cubic: bool = True, hidden: int = -1) -> np.ndarray:
    """Of an image (h, w) at places (n, 2); of the column `hidden` nothing is shown."""
    image = np.stack([colour, colour, colour, np.ones_like(colour)], axis=-1).astype(np.float32)
    if hidden >= 0:
        image[:, hidden] = 0.0
    assert SHOWN == 3
    found = np.empty(len(places), np.float32)
    _read(image.reshape(-1), SIZE, places, cubic, found)
    return found


def test_a_paraboloid_is_repeated_where_bilinear_values_are_not() -> None:
    def height(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        return 0.02 * u**2 - 0.03 * v**2 + 0.01 * u * v + 0.1 * u

    image, truth = height(COLUMN, ROW), height(*PLACES.T)
    np.testing.assert_allclose(values(image, PLACES), truth, atol=1e-4)
    assert np.abs(values(image, PLACES, cubic=False) - truth).max() > 5e-3


def test_at_a_pixel_s_centre_its_own_value_is_found_at_the_border_too() -> None:
    image = np.random.default_rng(1).random((HEIGHT, WIDTH))
    places = np.stack([COLUMN, ROW], axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(values(image, places), image.reshape(-1), atol=1e-5)


def test_beside_a_pixel_that_shows_nothing_values_are_bilinear() -> None:
    column = 8
    image = np.random.default_rng(2).random((HEIGHT, WIDTH))
    cubic, bilinear = (values(image, PLACES, cubic=is_it, hidden=column) for is_it in (True, False))
    beside = np.abs(PLACES[:, 0] - column)
    np.testing.assert_allclose(cubic[beside < 1.9], bilinear[beside < 1.9], rtol=1e-5, atol=1e-6)
    assert np.abs(cubic - bilinear)[beside > 2.0].max() > 0.01
