"""Colours of source images are brought together where depths and poses are slightly wrong."""

import numpy as np

from nvsf_core.kernels.images.source_lookup import LookUp, look_up_points
from nvsf_core.kernels.images.source_shifts import brought_together

ROWS, COLUMNS, FOCAL_PX, DEPTH_M = 60, 80, 100.0, 10.0
WEIGHT = np.array([1.0, 1.0], np.float32)
LIKELIEST = np.zeros((ROWS, COLUMNS), np.int64)


def picture(right_px: float = 0.0, down_px: float = 0.0) -> np.ndarray:
    """A smooth picture (3, h, w), 0..1, at places beside its own."""
    row, column = np.mgrid[:ROWS, :COLUMNS].astype(np.float64)
    x, y = column + right_px, row + down_px
    one = 0.5 + 0.2 * np.sin(0.5 * x + 0.1 * y) + 0.2 * np.cos(0.4 * y - 0.2 * x)
    return np.stack([one, 0.8 * one, 1.0 - one]).astype(np.float32)


def wall(moved_m: tuple[float, ...], *beside_px: tuple[float, float]) -> LookUp:
    """A wall with the picture before a view, and sources that are so far to the right of it.

    Each shows the wall's picture beside where its depth puts it.
    """
    row, column = np.mgrid[:ROWS, :COLUMNS]
    rays = np.stack(
        [(column - COLUMNS / 2) / FOCAL_PX, (row - ROWS / 2) / FOCAL_PX, np.ones((ROWS, COLUMNS))], axis=-1
    )
    matrix = np.array([[FOCAL_PX, 0, COLUMNS / 2], [0, FOCAL_PX, ROWS / 2], [0, 0, 1]])
    motions = np.zeros((1, len(moved_m), 3, 4))
    motions[0, :, :, :3] = matrix
    motions[0, :, 0, 3] = [-FOCAL_PX * each for each in moved_m]
    inverse = np.full((1, ROWS, COLUMNS), 1.0 / DEPTH_M, np.float32)
    images = np.zeros((len(moved_m), ROWS, COLUMNS, 5), np.float32)
    for k, (right_px, down_px) in enumerate(beside_px):
        seen = picture(right_px + FOCAL_PX * moved_m[k] / DEPTH_M, down_px)
        images[k, ..., :3], images[k, ..., 3] = seen.transpose(1, 2, 0), 1.0
    return LookUp(
        images, np.arange(len(moved_m)), motions.astype(np.float32), rays.astype(np.float32),
        np.zeros((ROWS, COLUMNS), np.uint8), inverse, (np.float32(0.1), np.float32(0.004)),
    )  # fmt: skip


def together(where: LookUp, blind: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """(k, 3, h, w) colours as they are looked up, and brought together; some sources may be blind there."""
    colour, seen = look_up_points(where)
    if blind is not None:
        seen &= ~blind[:, None]
        colour = np.where(seen[:, None], colour, np.nan)
    around = np.full((3, ROWS, COLUMNS), 0.5, np.float32)
    found = brought_together(where, LIKELIEST, colour, seen, around, WEIGHT)
    return colour[:, :, 0], found[:, :, 0]


def inner(x: np.ndarray) -> np.ndarray:
    """Without the rim, where a window sees less: of the farthest source 10 columns are outside."""
    return x[..., 8:-8, 20:-20]


def error(colour: np.ndarray) -> float:
    """Mean difference to the true picture."""
    return float(np.abs(inner(colour - picture())).mean())


def test_colours_at_the_same_places_stay() -> None:
    looked_up, found = together(wall((-0.5, 0.5), (0.0, 0.0), (0.0, 0.0)))
    np.testing.assert_allclose(inner(found), inner(looked_up), atol=1e-4)


def test_a_wrong_depth_moves_images_before_and_after_a_view_apart_and_they_meet() -> None:
    before, after = (error(x) for x in together(wall((-0.5, 0.5), (0.8, 0.0), (-0.8, 0.0))))
    assert after < 0.1 * before


def test_images_on_one_side_tell_where_the_view_lies_beyond_them() -> None:
    # By a depth that is wrong so much the farther image is moved by twice as much as the nearer one.
    _, found = together(wall((0.5, 1.0), (0.4, 0.0), (0.8, 0.0)))
    assert error(found) < 0.6 * error(picture(0.6))


def test_errors_of_poses_are_shared() -> None:
    before, after = (error(x) for x in together(wall((-0.5, 0.5), (0.0, 0.6), (0.0, -0.6))))
    assert after < 0.1 * before


def test_what_no_source_shows_takes_no_part() -> None:
    blind = np.zeros((2, ROWS, COLUMNS), np.bool_)
    blind[1, :, 40:] = True
    blind[:, :10] = True
    _, found = together(wall((0.0, 0.0), (0.0, 0.0), (0.0, 0.0)), blind)
    assert np.isfinite(found).all() and not found[:, :, :10].any() and not found[1, :, :, 40:].any()
    np.testing.assert_allclose(found[0, :, 12:-8, 50:], picture()[:, 12:-8, 50:], atol=0.02)


def test_a_moved_place_that_another_surface_hides_is_not_read() -> None:
    # The nearer source has something in front of the wall wherever it would be read again.
    where = wall((0.5, 1.0), (0.4, 0.0), (0.8, 0.0))
    colour, seen = look_up_points(where)
    around = np.full((3, ROWS, COLUMNS), 0.5, np.float32)
    where.images[:, :, :, :3], where.images[0, :, :, 4] = np.nan, 1.0 / (0.5 * DEPTH_M)
    found = brought_together(where, LIKELIEST, colour, seen, around, WEIGHT)
    assert np.isfinite(inner(found[0, :, 0])).all() and np.isnan(inner(found[1, :, 0])).all()


def test_the_smallest_windows_pass() -> None:
    whole = wall((0.0, 0.0), (0.0, 0.0), (0.0, 0.0))
    pixels = (slice(2), slice(2))
    small = whole._replace(
        images=np.ascontiguousarray(whole.images[(slice(None), *pixels)]),
        rays=np.ascontiguousarray(whole.rays[pixels]), label=np.ascontiguousarray(whole.label[pixels]),
        inverse=np.ascontiguousarray(whole.inverse[(slice(None), *pixels)]),
    )  # fmt: skip
    colour, seen = look_up_points(small)
    assert len(np.unique(colour[0, 0])) == 4 and seen.all()
    likeliest = np.ascontiguousarray(LIKELIEST[pixels])
    found = brought_together(small, likeliest, colour, seen, colour[0, :, 0], WEIGHT)
    np.testing.assert_allclose(found, colour, atol=1e-6)


def test_a_moved_colour_is_the_mean_of_what_is_moved_and_of_what_is_read_again() -> None:
    where = wall((-0.5, 0.5), (0.0, 0.0), (0.0, 0.0))
    colour, seen = look_up_points(where)
    around = np.full((3, ROWS, COLUMNS), 0.5, np.float32)
    darker = where._replace(images=where.images * np.float32([0.5, 0.5, 0.5, 1.0, 1.0]))
    found = brought_together(darker, LIKELIEST, colour, seen, around, WEIGHT)
    np.testing.assert_allclose(inner(found), 0.75 * inner(colour), atol=1e-3)


def test_each_depth_is_moved_by_itself() -> None:
    where = wall((0.5, 1.0), (0.0, 0.0), (0.0, 0.0))
    other = where.inverse.copy()
    other[:, :, 40:] = 0.5 / DEPTH_M
    both = where._replace(inverse=np.concatenate([where.inverse, other]))
    colour, seen = look_up_points(both)
    around = np.full((3, ROWS, COLUMNS), 0.5, np.float32)
    found = brought_together(both, LIKELIEST, colour, seen, around, WEIGHT)
    assert np.array_equal(found[:, :, 1, :, :40], found[:, :, 0, :, :40])
    far = (1, slice(None), 1, slice(8, -8), slice(45, 60))
    np.testing.assert_allclose(found[far], colour[far], atol=2e-3)
    assert np.abs(colour[far] - picture()[:, 8:-8, 45:60]).mean() > 0.1


def test_a_moving_object_is_read_where_its_own_motion_puts_it() -> None:
    still, moving = wall((0.5, 1.0), (0.0, 0.0), (0.0, 0.0)), wall((0.5, 0.5), (0.0, 0.0), (0.0, 0.0))
    shows_object = np.ones((2, ROWS, COLUMNS, 1), np.float32)
    where = still._replace(
        images=np.concatenate([moving.images, shows_object], axis=-1),
        motions=np.concatenate([still.motions, moving.motions]), label=np.ones_like(still.label),
    )  # fmt: skip
    _, found = together(where)
    np.testing.assert_allclose(inner(found), np.stack([inner(picture())] * 2), atol=0.02)


def test_of_a_sharp_view_colours_are_read_at_the_moved_place_alone() -> None:
    # A pattern of four pixels loses contrast each time that it is read between pixels.
    where = wall((-0.505, 0.505), (0.4, 0.0), (-0.4, 0.0))
    column = np.arange(COLUMNS)
    for k, right_px in enumerate((0.4 - 5.05, -0.4 + 5.05)):
        where.images[k, ..., :3] += 0.1 * np.sin(1.6 * (column + right_px))[None, :, None]
    colour, seen = look_up_points(where)
    around = np.full((3, ROWS, COLUMNS), 0.5, np.float32)
    read = [
        brought_together(where, LIKELIEST, colour, seen, around, WEIGHT, sharpness)[:, :, 0]
        for sharpness in (0.0, 0.5, 1.0)
    ]
    np.testing.assert_allclose(read[1], 0.5 * (read[0] + read[2]), atol=1e-6)
    softened, _, sharp = (float(np.abs(np.diff(inner(each))).mean()) for each in read)
    assert sharp > 1.005 * softened
