"""Laws of what a view shows where none of its sources shows anything."""

import numpy as np
import pytest
import torch

from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.recipe.residual import CameraSpec
from nvsf_core.rendering.camera_view import CameraView, camera_view, shown_images
from nvsf_core.rendering.lidar_view import lidar_view
from nvsf_core.rendering.pixel_support import holes, shown_by_others, without_holes
from nvsf_core.rendering.source_blend import coarse_colour, render_view
from nvsf_core.rendering.sources import DEPTH, SeenPoints, Sources
from nvsf_core.rendering.view_depth_maps import DepthMaps
from nvsf_core.rendering.warping import plane_rays

CAMERA = Pinhole(fx=40.0, fy=40.0, cx=31.5, cy=15.5, width=64, height=32)
WALL_M, POST_M = 20.0, 4.0
VALID = np.ones((32, 64), np.bool_)


def pose(right_m: float) -> np.ndarray:
    result = np.eye(4)
    result[0, 3] = right_m
    return result


def depth_map(right_m: float) -> np.ndarray:
    """A wall 20 m ahead, and a post 1 m wide before it."""
    across = (np.arange(64) - CAMERA.cx) / CAMERA.fx
    is_post = np.abs(across * POST_M + right_m) < 0.5
    return np.tile(1.0 / np.where(is_post, POST_M, WALL_M), (32, 1)).astype(np.float32)


def view(places_m: tuple[float, ...], factor: int = 1) -> CameraView:
    """From 0.6 m right of the first image, by that one alone; its level is 40, that of the next 200."""
    images = np.stack([np.full((32, 64, 3), level, np.uint8) for level in (40, 200)[: len(places_m)]])
    inverse = torch.from_numpy(np.stack([depth_map(right_m) for right_m in places_m]))
    shown = shown_images(images, VALID, factor).with_depths(
        DepthMaps(inverse, torch.zeros(inverse.shape).short())
    )
    at = pose(places_m[0] + 0.6)
    nothing = lidar_view(at, CAMERA, np.zeros((0, 3), np.float32), ())
    spec = CameraSpec(sources=1, plane_px=32 * 64 // factor**2)
    return camera_view(at, CAMERA, nothing, shown, np.stack([pose(x) for x in places_m]), spec)


HIDDEN = (slice(8, 24), slice(31, 34))
"""Pixels of the wall that the post hides in the first image alone."""


@pytest.mark.parametrize("factor", [1, 2])
def test_what_the_sources_do_not_show_other_images_do(factor: int) -> None:
    alone, helped = view((0.0,), factor), view((0.0, 3.0), factor)
    assert alone.others is None and helped.others is not None and helped.others.chosen == [1]
    assert (render_view(alone).rgb[HIDDEN] < 60).all()
    image = render_view(helped).rgb
    assert np.abs(image[HIDDEN].astype(int) - 200).max() <= 2
    assert (image[:, :20] == 40).all(), "what the source shows stays"


def test_colours_around_holes_are_those_of_other_images() -> None:
    coarse = coarse_colour(view((0.0, 3.0)))
    assert (coarse[:, *HIDDEN] * 255.0 - 200.0).abs().max() < 1.0


def test_of_other_images_nearer_ones_count_more_and_hidden_points_are_left_out() -> None:
    shown = shown_images(np.stack([np.full((32, 64, 3), x, np.uint8) for x in (100, 200)]), VALID, 1).full
    shown[:, DEPTH] = 1.0 / WALL_M
    points = SeenPoints(plane_rays(CAMERA), torch.full((1, 32, 64), 1.0 / WALL_M))
    missing = torch.zeros(32, 64, dtype=torch.bool)
    missing[10, 20:30] = True
    both = Sources(shown, [0, 1], torch.eye(4).expand(2, 4, 4), torch.tensor([1.0, 0.5]))
    colour, known = shown_by_others(both, points, CAMERA, missing)
    assert known.all() and colour.shape == (3, 10)
    torch.testing.assert_close(colour * 255.0, torch.full((3, 10), (100 + 200 * 0.25) / 1.25))
    hidden = shown.clone()
    hidden[0, DEPTH, :, :25] = 1.0
    colour, known = shown_by_others(
        Sources(hidden, [0, 1], both.motion, both.nearness), points, CAMERA, missing
    )
    assert known.all()
    assert (colour[:, :5] * 255.0 - 200.0).abs().max() < 1e-3


@pytest.mark.parametrize("own", [0.0, 0.5 / WALL_M])
def test_of_other_images_those_count_that_have_the_very_surface_in_their_own_maps(own: float) -> None:
    shown = shown_images(np.full((2, 32, 64, 3), 100, np.uint8), VALID, 1).full
    shown[1, :3] = 200.0 / 255.0
    shown[:, DEPTH] = 1.0 / WALL_M
    shown[0, DEPTH, :, :25] = own
    points = SeenPoints(plane_rays(CAMERA), torch.full((1, 32, 64), 1.0 / WALL_M))
    missing = torch.zeros(32, 64, dtype=torch.bool)
    missing[10, 20:30] = True
    both = Sources(shown, [0, 1], torch.eye(4).expand(2, 4, 4), torch.ones(2))
    colour, known = shown_by_others(both, points, CAMERA, missing)
    assert known.all()
    torch.testing.assert_close(colour[0] * 255.0, torch.tensor([200.0] * 5 + [150.0] * 5))


def test_without_other_images_or_missing_pixels_nothing_is_known() -> None:
    points = SeenPoints(plane_rays(CAMERA), torch.full((1, 32, 64), 1.0 / WALL_M))
    missing = torch.zeros(32, 64, dtype=torch.bool)
    colour, known = shown_by_others(None, points, CAMERA, missing)
    assert colour.shape == (3, 0) and known.shape == (0,)
    missing[3, 4:6] = True
    colour, known = shown_by_others(None, points, CAMERA, missing)
    assert colour.shape == (3, 2) and not known.any()


def test_a_hole_is_as_large_as_the_smallest_square() -> None:
    unknown = torch.zeros(20, 30, dtype=torch.bool)
    unknown[2:7, 3:8] = True
    whole = unknown.clone()
    unknown[12:16, 10:30] = True
    assert torch.equal(holes(unknown), whole)


def test_holes_take_the_colour_of_what_is_around_and_known_pixels_keep_theirs() -> None:
    colour = torch.zeros(3, 24, 40)
    colour[0, :, :20], colour[1, :, 20:] = 0.8, 0.6
    share = torch.ones(24, 40)
    share[4:12, 2:10] = 0.0
    share[14:20, 28:36] = 0.0
    filled = without_holes(torch.where(share > 0, colour, 9.0), share)
    assert torch.equal(filled[:, share > 0], colour[:, share > 0])
    assert (filled[0, 4:12, 2:10] - 0.8).abs().max() < 0.2
    assert (filled[1, 14:20, 28:36] - 0.6).abs().max() < 0.2
    assert (without_holes(colour, torch.zeros(24, 40)) == 0.0).all(), "nothing is known: black"
