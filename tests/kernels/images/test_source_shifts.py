"""Colours of source images are brought together where depths and poses are slightly wrong."""

import numpy as np

from nvsf_core.kernels.images.source_shifts import Surface, brought_together

ROWS, COLUMNS, FOCAL_PX, DEPTH_M = 60, 80, 100.0, 10.0
WEIGHT = np.array([1.0, 1.0], np.float32)


def picture(right_px: float = 0.0, down_px: float = 0.0) -> np.ndarray:
    """A smooth picture (3, h, w), 0..1, at places beside its own."""
    row, column = np.mgrid[:ROWS, :COLUMNS].astype(np.float64)
    x, y = column + right_px, row + down_px
    one = 0.5 + 0.2 * np.sin(0.5 * x + 0.1 * y) + 0.2 * np.cos(0.4 * y - 0.2 * x)
    return np.stack([one, 0.8 * one, 1.0 - one]).astype(np.float32)


def surface(*moved_m: float) -> Surface:
    """A wall before a view, and sources that are so far to the right of it."""
    row, column = np.mgrid[:ROWS, :COLUMNS]
    rays = np.stack(
        [(column - COLUMNS / 2) / FOCAL_PX, (row - ROWS / 2) / FOCAL_PX, np.ones((ROWS, COLUMNS))], axis=-1
    )
    matrix = np.array([[FOCAL_PX, 0, COLUMNS / 2], [0, FOCAL_PX, ROWS / 2], [0, 0, 1]])
    motions = np.zeros((1, len(moved_m), 3, 4))
    motions[0, :, :, :3] = matrix
    motions[0, :, 0, 3] = [-FOCAL_PX * each for each in moved_m]
    inverse = np.full((1, ROWS, COLUMNS), 1.0 / DEPTH_M, np.float32)
    label = np.zeros((ROWS, COLUMNS), np.uint8)
    return Surface(
        motions.astype(np.float32), rays.astype(np.float32), label, inverse,
        np.zeros((ROWS, COLUMNS), np.int64),
    )  # fmt: skip


def together(one: Surface, colour: np.ndarray, seen: np.ndarray | None = None) -> np.ndarray:
    """(k, 3, h, w) colours brought together, of colours (k, 3, h, w)."""
    everywhere = np.ones((len(colour), ROWS, COLUMNS), np.bool_) if seen is None else seen
    around = np.full((3, ROWS, COLUMNS), 0.5, np.float32)
    return brought_together(one, colour[:, :, None], everywhere[:, None], around, WEIGHT)[:, :, 0]


def inner(x: np.ndarray) -> np.ndarray:
    """Without the rim, where a window sees less."""
    return x[..., 8:-8, 8:-8]


def test_colours_at_the_same_places_stay() -> None:
    truth = picture()
    found = together(surface(-0.5, 0.5), np.stack([truth, truth]))
    np.testing.assert_allclose(found, np.stack([truth, truth]), atol=1e-6)


def test_a_wrong_depth_moves_images_before_and_after_a_view_apart_and_they_meet() -> None:
    colour = np.stack([picture(0.8), picture(-0.8)])
    found = together(surface(-0.5, 0.5), colour)
    before, after = (np.abs(inner(x - picture())).mean() for x in (colour, found))
    assert after < 0.1 * before


def test_images_on_one_side_tell_where_the_view_lies_beyond_them() -> None:
    # By a depth that is wrong so much the farther image is moved by twice as much as the nearer one.
    colour = np.stack([picture(0.4), picture(0.8)])
    found = together(surface(0.5, 1.0), colour)
    mean = np.abs(inner(picture(0.6) - picture())).mean()
    assert np.abs(inner(found - picture())).mean() < 0.6 * mean


def test_errors_of_poses_are_shared() -> None:
    colour = np.stack([picture(0.0, 0.6), picture(0.0, -0.6)])
    found = together(surface(-0.5, 0.5), colour)
    assert np.abs(inner(found - picture())).mean() < 0.1 * np.abs(inner(colour - picture())).mean()


def test_what_no_source_shows_takes_no_part() -> None:
    seen = np.ones((2, ROWS, COLUMNS), np.bool_)
    seen[1, :, 40:] = False
    seen[:, :10] = False
    colour = np.stack([picture(), picture()])
    colour[1, :, :, 40:] = np.nan
    found = together(surface(-0.5, 0.5), colour, seen)
    assert np.isfinite(found).all() and not found[:, :, :10].any() and not found[1, :, :, 40:].any()
    np.testing.assert_allclose(found[0, :, 12:-8, 50:], picture()[:, 12:-8, 50:], atol=0.02)


def test_the_smallest_windows_pass() -> None:
    one = surface(-0.5, 0.5)
    corner = (one.rays[:2, :2], one.label[:2, :2], one.inverse[:, :2, :2], one.likeliest[:2, :2])
    small = Surface(one.motions, *(np.ascontiguousarray(each) for each in corner))
    colour = np.full((2, 3, 1, 2, 2), 0.25, np.float32)
    found = brought_together(small, colour, np.ones((2, 1, 2, 2), np.bool_), colour[0, :, 0], WEIGHT)
    np.testing.assert_allclose(found, colour, atol=1e-6)
