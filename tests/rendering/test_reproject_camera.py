import numpy as np
import pytest
import torch

from nvsf_core.errors import ShapeError
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.kernels.images.splat import splat_depth
from nvsf_core.rendering.reproject_camera import (
    FAR_M,
    filled_depth,
    inverse_depth,
    nearest_sources,
    render_by_warping,
    splat_points,
)
from nvsf_core.rendering.warping import ray_length

CAMERA = Pinhole(fx=80.0, fy=80.0, cx=63.5, cy=31.5, width=128, height=64)
WALL_M = 8.0


def pose(right_m: float, forward_m: float = 0.0) -> np.ndarray:
    """Camera axes as the world's, moved."""
    result = np.eye(4)
    result[:3, 3] = [right_m, 0.0, forward_m]
    return result


def wall_colour(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    waves = [np.sin(2.1 * x + 0.3) * np.cos(1.7 * y), np.sin(1.3 * x + y), np.cos(0.9 * x - 1.6 * y)]
    return np.stack([127.0 + 100.0 * wave for wave in waves], axis=-1)


def photograph(place: np.ndarray) -> np.ndarray:
    """The textured wall z = 8 m, seen from a pose."""
    rays = CAMERA.rays(CAMERA.pixels())
    points = rays / rays[..., 2:] * (WALL_M - place[2, 3]) + place[:3, 3]
    return np.round(wall_colour(points[..., 0], points[..., 1])).astype(np.uint8)


def wall_points(spacing_m: float = 0.05, top_m: float = -9.0) -> np.ndarray:
    x, y = np.meshgrid(np.arange(-9.0, 9.0, spacing_m), np.arange(top_m, 9.0, spacing_m))
    return np.stack([x, y, np.full_like(x, WALL_M)], axis=-1).reshape(-1, 3).astype(np.float32)


def psnr_db(found: np.ndarray, truth: np.ndarray) -> float:
    return float(-10.0 * np.log10(np.mean(((found.astype(float) - truth) / 255.0) ** 2) + 1e-12))


def test_a_wall_between_two_photographs_is_seen_again() -> None:
    sources = [pose(-0.5), pose(0.5)]
    images = np.stack([photograph(place) for place in sources])
    view = render_by_warping(pose(0.1), CAMERA, wall_points(), images, np.stack(sources), sweep=False)
    assert view.rgb.all(), "the wall is nowhere black"
    assert psnr_db(view.rgb, photograph(pose(0.1))) > 40.0


def test_a_pixel_is_as_far_away_as_the_wall_along_its_ray() -> None:
    image = photograph(pose(0.0))[None]
    view = render_by_warping(pose(0.0), CAMERA, wall_points(), image, pose(0.0)[None])
    rays = CAMERA.rays(CAMERA.pixels())
    np.testing.assert_allclose(view.range_m, WALL_M / rays[..., 2], rtol=1e-4)
    lengths = ray_length(torch.tensor([[0.0, -1e-3]]), Pinhole(fx=1, fy=1, cx=0, cy=0, width=2, height=1))
    assert torch.isinf(lengths).all(), "inverse depths that refining moved beyond infinity"


def test_of_a_camera_that_looks_down_few_upper_rows_may_be_asked() -> None:
    # Its optical axis is far below them.
    given = pose(0.0), CAMERA, wall_points(), torch.zeros(1, 3, 64, 128), pose(0.0)[None]
    upper = inverse_depth(*given, rows=10)
    assert upper.shape == (10, 128)
    torch.testing.assert_close(upper[:6], inverse_depth(*given)[:6], rtol=1e-4, atol=0.0)


def test_a_target_at_a_source_gives_that_image() -> None:
    sources = np.stack([pose(0.0), pose(5.0)])
    images = np.stack([photograph(pose(0.0)), photograph(pose(5.0))])
    view = render_by_warping(pose(0.0), CAMERA, wall_points(), images[:1], sources[:1])
    np.testing.assert_array_equal(view.rgb, images[0])


def test_the_plane_sweep_finds_depth_where_there_is_no_return() -> None:
    sources = [pose(-0.6), pose(0.6)]
    images = np.stack([photograph(place) for place in sources])
    nearer = wall_points(top_m=1.5) * np.float32(0.5)  # the only returns: a low fence, before the wall
    truth = photograph(pose(0.1))
    plain = render_by_warping(pose(0.1), CAMERA, nearer, images, np.stack(sources), sweep=False)
    swept = render_by_warping(pose(0.1), CAMERA, nearer, images, np.stack(sources))
    upper = (slice(0, 24), slice(16, 112))
    assert psnr_db(swept.rgb[upper], truth[upper]) > psnr_db(plain.rgb[upper], truth[upper]) + 5


def test_what_no_source_shows_is_black_and_unanswered() -> None:
    image = photograph(pose(0.0))[None]
    view = render_by_warping(pose(8.0), CAMERA, wall_points(), image, pose(0.0)[None])
    is_black = (view.rgb == 0).all(axis=2)
    assert is_black.any() and not is_black.all()


def test_masked_source_pixels_do_not_answer() -> None:
    valid = np.ones((64, 128), dtype=bool)
    valid[:, :40] = False
    image = photograph(pose(0.0))[None]
    view = render_by_warping(pose(0.0), CAMERA, wall_points(), image, pose(0.0)[None], source_valid=valid)
    np.testing.assert_array_equal((view.rgb > 0).all(axis=2), valid)


def test_without_any_return_the_view_is_as_far_as_the_sky() -> None:
    nothing = np.zeros((0, 3), np.float32)
    depth, gap = filled_depth(pose(0.0), CAMERA, nothing, splat_points(pose(0.0), CAMERA, nothing))
    assert (depth == FAR_M).all()
    assert np.isinf(gap).all()


def test_a_wall_hides_returns_that_shine_through_its_gaps() -> None:
    spread = np.array([1.0, 1.0, 1.0], np.float32)
    near = wall_points(spacing_m=0.15) * np.array([0.5, 0.5, 0.5], np.float32)
    behind = wall_points(spacing_m=0.1) * 2.5 * spread
    depth = splat_depth(
        np.concatenate([behind, near]), np.eye(4), (80.0, 80.0, 63.5, 31.5), (64, 128), radius_m=0.1
    )
    assert np.isfinite(depth).mean() > 0.3
    assert np.nanmax(np.where(np.isfinite(depth), depth, np.nan)) < 5.0


def test_the_nearest_point_of_a_pixel_wins_and_points_behind_the_camera_do_not_count() -> None:
    points = np.array([[0, 0, 9], [0, 0, 4], [0, 0, -3], [0, 0, 0.1], [np.nan, 0, 1]], np.float32)
    depth = splat_depth(points, np.eye(4), (10.0, 10.0, 1.0, 1.0), (3, 3))
    assert depth[1, 1] == 4.0
    assert np.isfinite(depth).sum() == 1


def test_the_two_nearest_sources_are_chosen() -> None:
    places = np.stack([pose(x) for x in (9.0, 1.0, -2.0, 4.0)])
    assert nearest_sources(pose(0.0), places) == [1, 2]


def test_sources_that_look_the_other_way_come_after_those_nearby_and_not_after_far_ones() -> None:
    places = np.stack([pose(x) for x in (0.5, 1.0, 5.0, 80.0)])
    places[:2, :3, :3] = np.diag([-1.0, 1.0, -1.0])
    assert nearest_sources(pose(0.0), places, 3) == [2, 0, 1]
    across = places.copy()
    across[:2, :3, :3] = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    assert nearest_sources(pose(0.0), across, 3) == [0, 1, 2], "a bend is no way back"


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(ShapeError, match="source images"):
        nothing = np.zeros((0, 64, 128, 3), np.uint8)
        render_by_warping(pose(0.0), CAMERA, wall_points(), nothing, np.zeros((0, 4, 4)))


def test_without_any_return_the_plane_sweep_alone_finds_the_wall() -> None:
    sources = [pose(-0.6), pose(0.6)]
    images = np.stack([photograph(place) for place in sources])
    nothing = np.zeros((0, 3), np.float32)
    truth = photograph(pose(0.1))
    flat = render_by_warping(pose(0.1), CAMERA, nothing, images, np.stack(sources), sweep=False)
    swept = render_by_warping(pose(0.1), CAMERA, nothing, images, np.stack(sources))
    assert psnr_db(swept.rgb, truth) > psnr_db(flat.rgb, truth) + 3.0


def test_depth_on_a_road_is_that_of_pixel_centres() -> None:
    g = np.random.default_rng(0)
    x, z = g.uniform(-12.0, 12.0, 60_000), g.uniform(3.0, 25.0, 60_000)
    road = np.stack([x, np.full_like(x, 1.7), z], axis=1).astype(np.float32)
    depth_m, _ = filled_depth(pose(0.0), CAMERA, road, splat_points(pose(0.0), CAMERA, road))
    truth_m = CAMERA.fy * 1.7 / (np.arange(CAMERA.height) - CAMERA.cy)
    rows = slice(40, 60)
    share = np.abs(depth_m / truth_m[:, None] - 1.0)[rows, 4:-4]
    # A pixel of these rows spans 3 to 12 % of its depth.
    assert np.median(share) < 0.001
    assert np.percentile(share, 95) < 0.01
