"""Depths at pixel centres, from points that lie anywhere in their pixels."""

import numpy as np
import pytest

from nvsf_core.kernels.images.local_planes import on_planes
from nvsf_core.kernels.images.splat import mean_places, splat_depth

INTRINSICS = (40.0, 40.0, 31.5, 15.5)
SHAPE = (32, 64)
EVERYWHERE = np.ones(SHAPE, np.bool_)


def points_of(inverse_at: tuple[float, float, float], count: int = 6000) -> np.ndarray:
    """Points (m, 3), metres, of the plane with inverse depth a + b column + c row, at random places."""
    a, b, c = inverse_at
    g = np.random.default_rng(1)
    u, v = g.uniform(-0.5, SHAPE[1] - 0.5, count), g.uniform(-0.5, SHAPE[0] - 0.5, count)
    z = 1.0 / (a + b * u + c * v)
    fx, fy, cx, cy = INTRINSICS
    return np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z], axis=1).astype(np.float32)


def plane(inverse_at: tuple[float, float, float]) -> np.ndarray:
    """The same inverse depths (H, W), 1/m, at pixel centres."""
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]]
    a, b, c = inverse_at
    return (a + b * column + c * row).astype(np.float32)


def places_of(points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    depth_m = splat_depth(points_m, np.eye(4), INTRINSICS, SHAPE)
    return mean_places(points_m, np.eye(4), INTRINSICS, depth_m), depth_m


def test_the_mean_of_a_pixels_points_leaves_out_what_lies_behind() -> None:
    fx, _, cx, cy = INTRINSICS
    at = [(20.1, 10.0, 5.0), (20.3, 10.4, 5.1), (20.0, 10.0, 9.0)]
    points = np.array([[(u - cx) / fx * z, (v - cy) / fx * z, z] for u, v, z in at], np.float32)
    places, _ = places_of(points)
    np.testing.assert_allclose(places[10, 20], [2.0, 20.2, 10.2, 0.5 * (1 / 5.0 + 1 / 5.1)], rtol=1e-5)
    assert np.count_nonzero(places[..., 0]) == 1


def test_a_slanted_plane_is_met_at_pixel_centres() -> None:
    road = (0.05, 0.0004, 0.004)
    places, depth_m = places_of(points_of(road))
    truth = plane(road)
    guess = np.where(np.isfinite(depth_m), 1.0 / depth_m, truth).astype(np.float32)
    found = on_planes(places, guess, EVERYWHERE)
    # The nearest point of each pixel, which was taken before, is off by half of a pixel's slope.
    assert np.median(np.abs(guess - truth)) > 1e-3
    assert np.median(np.abs(found - truth)) < 5e-5
    # At the image's border, where points are on one side only, a sixth of the slope.
    assert np.abs(found - truth).max() < 0.004 / 6.0


def test_a_plane_does_not_bend_towards_what_stands_before_it() -> None:
    wall, post = points_of((0.05, 0.0, 0.0)), points_of((0.2, 0.0, 0.0))
    fx, _, cx, _ = INTRINSICS
    column = post[:, 0] / post[:, 2] * fx + cx
    places, _ = places_of(np.concatenate([wall, post[(column > 30.0) & (column < 34.0)]]))
    is_post = (np.abs(np.arange(SHAPE[1]) - 32) < 2)[None, :].repeat(SHAPE[0], axis=0)
    guess = np.where(is_post, 0.2, 0.05).astype(np.float32)
    found = on_planes(places, guess, EVERYWHERE)
    np.testing.assert_allclose(found, guess, rtol=1e-4)


@pytest.mark.parametrize("count", [0, 3])
def test_with_few_points_the_guess_stays(count: int) -> None:
    places, _ = places_of(points_of((0.1, 0.001, 0.0), count=6000)[:count])
    guess = np.full(SHAPE, 0.1, np.float32)
    np.testing.assert_array_equal(on_planes(places, guess, EVERYWHERE), guess)


def test_pixels_that_are_not_near_keep_the_guess() -> None:
    places, _ = places_of(points_of((0.1, 0.001, 0.001)))
    guess = np.full(SHAPE, 0.15, np.float32)
    near = EVERYWHERE.copy()
    near[:, 30:] = False
    found = on_planes(places, guess, near)
    np.testing.assert_array_equal(found[:, 30:], guess[:, 30:])
    assert (found[:, :30] != guess[:, :30]).any()


def test_where_in_its_row_a_pixel_lies_makes_no_difference() -> None:
    # Pixels are added up many at a time; of a wide image the same part lies elsewhere among them.
    g = np.random.default_rng(3)
    places = np.concatenate([g.integers(0, 3, (9, 700, 1)), g.uniform(0.1, 0.12, (9, 700, 3))], axis=2)
    places[..., 1] += np.arange(700)
    places[..., 2] += np.arange(9)[:, None]
    guess, near = g.uniform(0.1, 0.12, (9, 700)).astype(np.float32), g.random((9, 700)) < 0.5
    places = places.astype(np.float32)
    whole = on_planes(places, guess, near)
    moved = places[:, 100:].copy()
    moved[..., 1] -= 100.0
    part = on_planes(moved, guess[:, 100:].copy(), near[:, 100:].copy())
    assert (whole != guess).mean() > 0.3
    np.testing.assert_allclose(part[:, 3:], whole[:, 103:], atol=1e-6)
