"""Images prove a wall's distance, and of the sky nothing."""

import numpy as np
import pytest
import torch

from nvsf_core.evidence.image_surfels import DepthRays
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.rendering.image_depth import image_depth, without_sky
from nvsf_core.rendering.rendered import RenderedImage
from nvsf_core.rendering.sources import Sources
from nvsf_core.rendering.warping import relative_motion, to_float

CAMERA = Pinhole(fx=90.0, fy=90.0, cx=95.5, cy=47.5, width=192, height=96)
WALL_M, TOP_M = 8.0, -1.5
"""Of a wall across the view: how far ahead, and its upper edge (y points down)."""


def pose(right_m: float) -> np.ndarray:
    place = np.eye(4)
    place[0, 3] = right_m
    return place


def photograph(right_m: float) -> np.ndarray:
    """The textured wall under an even sky."""
    rays = CAMERA.rays(CAMERA.pixels())
    point = rays / rays[..., 2:] * WALL_M
    x, y = point[..., 0] + right_m, point[..., 1]
    waves = [np.sin(5.1 * x + 0.3) * np.cos(4.7 * y), np.sin(3.3 * x + y), np.cos(2.9 * x - 3.6 * y)]
    wall = 127.0 + 100.0 * np.stack(waves, axis=-1)
    return np.round(np.where((y < TOP_M)[..., None], [180.0, 200.0, 230.0], wall)).astype(np.uint8)


UP = np.array([0.0, -1.0, 0.0])


def depths(*places_m: float, up: np.ndarray = UP, elevation_rad: float = -1.5) -> DepthRays:
    images = np.stack([photograph(x) for x in places_m])
    valid = np.ones((CAMERA.height, CAMERA.width), np.bool_)
    poses = np.stack([pose(x) for x in places_m])
    nothing = np.zeros((0, 3), np.float32)
    return image_depth(pose(0.0), CAMERA, nothing, images, poses, valid, up=up, elevation_rad=elevation_rad)


def test_a_wall_is_as_far_as_it_is_and_the_sky_is_not_near() -> None:
    found = depths(-0.4, 0.4)
    height_m = found.direction[:, 1] / found.direction[:, 2] * WALL_M
    wall, sky = height_m > TOP_M + 1.0, height_m < TOP_M - 1.2
    assert wall.sum() > 2000 and sky.sum() > 500
    assert np.isinf(found.range_m[sky]).mean() > 0.95
    near = wall & np.isfinite(found.range_m)
    assert near.sum() > 0.95 * wall.sum()
    z_m = found.range_m[near] * found.direction[near, 2]
    assert np.median(np.abs(z_m - WALL_M)) < 0.5, "planes lie 0.4 m apart there"
    assert np.allclose(np.linalg.norm(found.direction, axis=1), 1.0, atol=1e-5)


@pytest.mark.parametrize("places_m", [(0.3,), (0.0, 1e-3)], ids=["one image", "two from one place"])
def test_nothing_is_proven_without_a_second_place(places_m: tuple[float, ...]) -> None:
    found = depths(*places_m)
    assert not np.isfinite(found.range_m).any()


def test_rays_that_rise_are_told_as_if_all_were_asked() -> None:
    everything, rising = depths(-0.4, 0.4), depths(-0.4, 0.4, elevation_rad=0.1)
    asked = everything.direction @ UP > np.sin(0.1)
    assert 1000 < asked.sum() < 0.5 * len(asked)
    assert np.array_equal(rising.direction, everything.direction[asked])
    assert np.array_equal(rising.range_m, everything.range_m[asked]), "the wall's texture needs no pull"
    nodding = np.array([0.0, -np.cos(0.2), np.sin(0.2)])
    assert len(depths(-0.4, 0.4, up=nodding, elevation_rad=0.1).range_m) > asked.sum()
    assert len(depths(-0.4, 0.4, elevation_rad=1.5).range_m) == 0


NEAR_M = 6.0
"""Depth of the sky as a comparison of images has it: of something beside it."""
LEVEL = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""A camera in a scene whose z is up."""


def shown_without_sky(rgb: np.ndarray, gap_px: float, label: np.ndarray | None = None) -> np.ndarray:
    """Ranges (H, W) of the wall's view, the whole of which is rendered at 8 and the sky at 6 m."""
    rays = CAMERA.rays(CAMERA.pixels())
    is_sky = rays[..., 1] / rays[..., 2] * WALL_M < TOP_M
    range_m = np.where(is_sky, NEAR_M, WALL_M) / rays[..., 2]
    images = to_float(np.stack([photograph(x) for x in (-0.4, 0.4)]))
    motion = torch.stack([relative_motion(pose(0.0), pose(x)) for x in (-0.4, 0.4)])
    sources = Sources(
        torch.cat([images, torch.ones_like(images[:, :1])], dim=1), [0, 1], motion, torch.ones(2)
    )
    found = without_sky(
        RenderedImage(rgb, range_m.astype(np.float32)), LEVEL, CAMERA, sources,
        torch.full(is_sky.shape, gap_px), label=None if label is None else torch.from_numpy(label),
    )  # fmt: skip
    assert found.rgb is rgb, "colours stay"
    kept = np.isfinite(found.range_m)
    assert np.array_equal(found.range_m[kept], range_m.astype(np.float32)[kept])
    return np.stack([kept, is_sky])


def test_the_sky_of_a_rendered_image_has_no_range_and_what_stands_before_it_keeps_its_own() -> None:
    kept, is_sky = shown_without_sky(photograph(0.0), np.inf)
    assert kept[is_sky].mean() < 0.1 and kept[~is_sky].mean() > 0.99


def test_a_surface_beside_returns_a_dark_one_and_a_moving_one_are_no_sky() -> None:
    rgb = photograph(0.0)
    assert shown_without_sky(rgb, 1.0)[0].all(), "a return says that there is a surface"
    assert shown_without_sky(rgb, np.inf, np.ones(rgb.shape[:2], np.uint8))[0].all()
    kept, is_sky = shown_without_sky(np.where((rgb == [180, 200, 230]).all(-1)[..., None], 0, rgb), np.inf)
    assert kept[is_sky].all(), "dark"
