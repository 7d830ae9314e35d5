"""Laws of depth planes and of blended views, on photographs of a textured wall."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.kernels.images.plane_features import N_FEATURES
from nvsf_core.recipe.residual import CameraSpec
from nvsf_core.rendering import plane_depth
from nvsf_core.rendering.camera_view import (
    CameraView,
    camera_view,
    shown_images,
)
from nvsf_core.rendering.lidar_view import MovingPoints, lidar_view, moving_pixels
from nvsf_core.rendering.plane_depth import likeliest_depth, plane_features, plane_inverses, resized
from nvsf_core.rendering.plane_volume import Agreement, agreement
from nvsf_core.rendering.rendered import Support
from nvsf_core.rendering.source_blend import render_view
from nvsf_core.rendering.sources import SeenPoints
from nvsf_core.rendering.view_depth_maps import DepthMaps
from nvsf_core.rendering.warping import plane_rays

CAMERA = Pinhole(fx=80.0, fy=80.0, cx=63.5, cy=31.5, width=128, height=64)
WALL_M = 8.0
SPEC = CameraSpec(sources=3, planes=24, plane_px=64 * 32)
NOTHING = np.zeros((0, 3), np.float32)


def pose(right_m: float) -> np.ndarray:
    result = np.eye(4)
    result[0, 3] = right_m
    return result


def photograph(place: np.ndarray) -> np.ndarray:
    """The textured wall z = 8 m, seen from a pose."""
    rays = CAMERA.rays(CAMERA.pixels())
    x, y, _ = np.moveaxis(rays / rays[..., 2:] * WALL_M + place[:3, 3], -1, 0)
    waves = [np.sin(2.1 * x + 0.3) * np.cos(1.7 * y), np.sin(1.3 * x + y), np.cos(0.9 * x - 1.6 * y)]
    return np.round(np.stack([127.0 + 100.0 * wave for wave in waves], axis=-1)).astype(np.uint8)


def wall_points() -> np.ndarray:
    x, y = np.meshgrid(np.arange(-9.0, 9.0, 0.1), np.arange(-9.0, 9.0, 0.1))
    return np.stack([x, y, np.full_like(x, WALL_M)], axis=-1).reshape(-1, 3).astype(np.float32)


PLACES = np.stack([pose(x) for x in (-0.6, 0.0, 0.5, 1.1)])
PHOTOGRAPHS = np.stack([photograph(place) for place in PLACES])
VALID = np.ones((64, 128), np.bool_)


def wall_maps(images: int = 4) -> DepthMaps:
    shape = (images, CAMERA.height, CAMERA.width)
    return DepthMaps(torch.full(shape, 1.0 / WALL_M), torch.zeros(shape, dtype=torch.int16))


def view(points: np.ndarray, *, images: int = 4, depths: DepthMaps | None = None) -> CameraView:
    """The second photograph, left out: by the others, and by their depths if they are given."""
    shown = shown_images(PHOTOGRAPHS[:images], VALID, 2)
    return camera_view(
        pose(0.0), CAMERA, lidar_view(pose(0.0), CAMERA, points, ()),
        shown if depths is None else shown.with_depths(depths), PLACES[:images], SPEC, leave_out=(1,),
    )  # fmt: skip


def test_a_left_out_image_is_no_source_and_missing_sources_have_no_weight() -> None:
    assert view(NOTHING).near.chosen == [2, 0, 3]
    alone = view(NOTHING, images=3)
    assert alone.near.chosen == [2, 0, 0]
    assert alone.near.nearness[2] == 0.0


def test_sources_agree_best_on_the_plane_of_the_wall() -> None:
    one, inverses = view(NOTHING), plane_inverses(SPEC)
    points = SeenPoints(plane_rays(one.small), inverses[:, None, None])
    agreed = agreement(one.near.of(one.images.small), points, one.small)
    size = (one.small.height, one.small.width)
    features = plane_features(agreed, torch.full(size, 1 / 300.0), torch.full(size, torch.inf), inverses)
    assert features.shape == (SPEC.planes, N_FEATURES, *size)
    assert torch.isfinite(features).all()
    disagreement = features[:, 2, 8:-8, 16:-16].mean(dim=(1, 2))
    assert abs(int(disagreement.argmin()) - int((inverses - 1 / WALL_M).abs().argmin())) <= 1


@pytest.mark.parametrize("knows", [True, False])
def test_planes_are_described_as_torch_says(knows: bool) -> None:
    rng = torch.Generator().manual_seed(3)
    inverses, size = plane_inverses(SPEC), (9, 14)
    agreed = Agreement(torch.rand(SPEC.planes, *size, 6, generator=rng), torch.zeros(SPEC.planes, 3, *size))
    prior = 0.4 * torch.rand(size, generator=rng)
    gap_px = 9.0 * torch.rand(size, generator=rng) if knows else torch.full(size, torch.inf)
    ours = plane_features(agreed, prior, gap_px, inverses)
    trust, is_known = torch.exp(-gap_px / plane_depth._TRUST_PX), torch.full(size, float(knows))
    theirs = plane_depth._plane_features(agreed, prior, trust, is_known, inverses)
    assert ours.stride() == theirs.stride(), "channels last, as convolutions want them"
    torch.testing.assert_close(ours, theirs, atol=2e-6, rtol=1e-5)


def test_the_likeliest_depth_lies_between_planes_and_takes_none_of_another_surface() -> None:
    inverses = torch.linspace(0.0, 1.0, 21)
    probability = torch.zeros(21, 1, 1)
    probability[3], probability[4], probability[15] = 0.35, 0.3, 0.3
    inverse, mass = likeliest_depth(probability, inverses)
    assert float(inverse) == pytest.approx((0.35 * 0.15 + 0.3 * 0.2) / 0.65)
    assert float(mass) == pytest.approx(0.65)


def test_the_lidar_tells_the_depth_at_its_returns_and_the_maps_tell_it_beside_them() -> None:
    # Its one return lies in front of the wall that one map of three shows.
    nearer, maps = np.array([[0.01, 0.01, 0.8 * WALL_M]], np.float32), wall_maps()
    maps.inverse[[0, 3]] = 0.0
    one = view(nearer, depths=maps)
    shown = render_view(one).range_m * CAMERA.rays(CAMERA.pixels())[..., 2]
    own = np.unravel_index(int(one.gap_px.argmin()), one.gap_px.shape)
    np.testing.assert_allclose(shown[own], 0.8 * WALL_M, rtol=0.01)
    assert one.surfaces is not None
    beside = ((one.gap_px >= 2.0) & (one.surfaces.support[0] > 0.0)).numpy()
    assert beside.mean() > 0.9
    np.testing.assert_allclose(shown[beside], WALL_M, rtol=0.01)


@pytest.mark.parametrize("points", [NOTHING, wall_points()])
def test_a_view_shows_the_wall_where_the_depths_of_images_are_known(points: np.ndarray) -> None:
    shown = render_view(view(points, depths=wall_maps()))
    assert shown.support is not None and (shown.support == Support.SEEN)[8:-8, 16:-16].all()
    error = np.abs(shown.rgb.astype(float) - PHOTOGRAPHS[1])[8:-8, 16:-16]
    assert np.median(error) < 12.0
    length_m = WALL_M / CAMERA.rays(CAMERA.pixels())[..., 2]
    assert np.median(np.abs(shown.range_m / length_m - 1.0)[8:-8, 16:-16]) < 0.01


def test_off_the_path_a_view_is_more_like_its_nearest_source_and_within_a_metre_the_same() -> None:
    # The farther sources show the wall brighter.
    given = view(NOTHING, depths=wall_maps())
    given.images.full[[0, 3], :3] += 0.05
    only_first = given.near.nearness * (given.near.nearness == 1.0)
    nearest = replace(given, near=replace(given.near, nearness=only_first))
    places_m = (0.0, 1.0, 2.0, 3.0, 5.0)
    shown = [render_view(replace(given, off_path_m=away_m)).rgb.astype(float) for away_m in places_m]
    assert np.array_equal(shown[0], shown[1]) and np.array_equal(shown[3], shown[4])
    alone = render_view(nearest).rgb.astype(float)
    apart = [np.abs(shown[number] - alone)[8:-8, 24:-24].mean() for number in (0, 2, 3)]
    assert apart[2] < apart[1] < apart[0]


def test_between_two_surfaces_lies_no_depth_and_along_one_it_is_even() -> None:
    columns = torch.arange(8.0)
    inverse = torch.where(columns < 4, 0.10 + 0.001 * columns, 0.30).expand(2, 8)
    share = torch.where(columns < 4, 0.9, 0.2).expand(2, 8)
    x = (torch.arange(32) + 0.5) / 16.0 - 1.0
    places = torch.stack([x, torch.zeros(32)], dim=-1)[None]
    finer, trust = resized(torch.stack([inverse, share]), places, 0.01)
    near = torch.arange(32) < 16
    expected = 0.10 + 0.001 * ((torch.arange(32) + 0.5) / 4.0 - 0.5).clamp_min(0.0)
    torch.testing.assert_close(finer[0, :14], expected[:14])
    assert (finer[..., near] < 0.104).all() and (finer[..., ~near] > 0.299).all()
    assert (trust[..., near] > 0.89).all() and (trust[..., ~near] < 0.21).all()


THING_M = 4.0
"""Depth of a plate that moves to the right in front of the wall, 0.5 m wide, uniformly bright."""


def plate(centre_m: float) -> np.ndarray:
    x, y = np.meshgrid(np.arange(-0.25, 0.26, 0.02), np.arange(-0.25, 0.26, 0.02))
    return np.stack([x + centre_m, y, np.full_like(x, THING_M)], axis=-1).reshape(-1, 3).astype(np.float32)


def with_plate(place: np.ndarray, centre_m: float) -> np.ndarray:
    rays = CAMERA.rays(CAMERA.pixels())
    at = rays / rays[..., 2:] * THING_M + place[:3, 3] - np.array([centre_m, 0.0, 0.0])
    is_plate = (np.abs(at[..., :2]) <= 0.25).all(axis=-1)
    return np.where(is_plate[..., None], np.uint8([255, 0, 255]), photograph(place))


def test_what_moves_is_shown_once_and_where_it_is() -> None:
    centres = (-0.9, 0.0, 0.9, 1.8)
    images = np.stack([with_plate(place, x) for place, x in zip(PLACES, centres, strict=True)])
    shadows = np.stack(
        [moving_pixels(p, CAMERA, wall_points(), [plate(x)]) for p, x in zip(PLACES, centres, strict=True)]
    )
    moved = np.tile(np.eye(4), (4, 1, 1))
    moved[:, 0, 3] = centres
    is_plate = torch.from_numpy((images == np.uint8([255, 0, 255])).all(axis=-1))
    # As `image_depths` gives it: unknown around the plate.
    inverse = torch.where(is_plate, 1.0 / THING_M, torch.where(torch.from_numpy(shadows), 0.0, 1.0 / WALL_M))
    maps = DepthMaps(inverse, is_plate.to(torch.int16) * 7)
    shown = shown_images(images, VALID, 2, shadows).with_depths(maps)
    moving = [MovingPoints(7, plate(0.0), moved)]
    lidar = lidar_view(pose(0.0), CAMERA, wall_points(), moving)
    one = camera_view(pose(0.0), CAMERA, lidar, shown, PLACES, SPEC, leave_out=(1,), moving=moving)
    assert one.label is not None and (one.label.numpy() > 0)[28:36, 60:68].all()
    error = np.abs(render_view(one).rgb.astype(float) - images[1]).max(axis=-1)
    middle = (slice(28, 36), slice(60, 68))
    assert error[middle].max() < 30.0
    # The plate stands at another place of every source: none may leave a ghost on the wall.
    assert np.percentile(error[8:-8, 16:-16], 95) < 60.0


def test_a_static_view_holds_nothing_dynamic() -> None:
    one = view(wall_points())
    assert one.label is None and one.near.moved is None and one.images.full.shape[1] == 5
