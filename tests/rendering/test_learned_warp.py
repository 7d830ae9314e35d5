"""Laws of depth planes and of the learned camera, on photographs of a textured wall."""

import numpy as np
import pytest
import torch

from nvsf_core.fields.camera_networks import VOLUME_FEATURES, CameraNetworks
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.recipe import CameraSpec
from nvsf_core.rendering.learned_warp import (
    CameraView,
    believe_depth,
    blend_sources,
    camera_view,
    render_view,
    shown_images,
)
from nvsf_core.rendering.plane_volume import depth_belief, plane_inverses, plane_volume, volume_features
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


def view(points: np.ndarray, *, images: int = 4, leave_out: int | None = 1) -> CameraView:
    return camera_view(
        pose(0.0),
        CAMERA,
        points,
        shown_images(PHOTOGRAPHS[:images], VALID),
        PLACES[:images],
        SPEC,
        leave_out=leave_out,
    )


def test_a_left_out_image_is_no_source_and_missing_sources_have_no_weight() -> None:
    assert view(NOTHING).chosen == [2, 0, 3]
    alone = view(NOTHING, images=3)
    assert alone.chosen == [2, 0, 0]
    assert alone.nearness[2] == 0.0


def test_sources_agree_best_on_the_plane_of_the_wall() -> None:
    one, inverses = view(NOTHING), plane_inverses(SPEC)
    volume = plane_volume(one.small_sources(), plane_rays(one.small), one.small, inverses)
    size = (one.small.height, one.small.width)
    features = volume_features(volume, torch.full(size, 1 / 300.0), torch.full(size, torch.inf), inverses)
    assert features.shape == (VOLUME_FEATURES, SPEC.planes, *size)
    assert torch.isfinite(features).all()
    agreement = features[2, :, 8:-8, 16:-16].mean(dim=(1, 2))
    assert abs(int(agreement.argmin()) - int((inverses - 1 / WALL_M).abs().argmin())) <= 1


def test_two_separate_depths_of_a_pixel_are_both_found() -> None:
    inverses = torch.linspace(0.0, 1.0, 21)
    probability = torch.zeros(21, 1, 1)
    probability[3:5], probability[15] = 0.3, 0.4
    belief = depth_belief(probability, torch.rand(21, 3, 1, 1), inverses)
    assert belief.inverse[:, 0, 0].tolist() == pytest.approx([0.75, 0.175])
    assert belief.probability[:, 0, 0].tolist() == pytest.approx([0.4, 0.6])


def test_untrained_networks_show_the_wall_where_the_lidar_knows_it() -> None:
    networks = CameraNetworks(SPEC, torch.Generator().manual_seed(0))
    rgb = render_view(networks, view(wall_points()), SPEC)
    error = np.abs(rgb.astype(float) - PHOTOGRAPHS[1])[8:-8, 16:-16]
    assert np.median(error) < 12.0


@torch.no_grad()
def test_a_window_shows_what_the_whole_view_shows_there() -> None:
    networks = CameraNetworks(SPEC, torch.Generator().manual_seed(0))
    one = view(wall_points())
    belief = believe_depth(networks.depth, one, SPEC)
    window = (slice(8, 40), slice(16, 80))
    part = blend_sources(networks.blend, one, belief, window)
    torch.testing.assert_close(part, blend_sources(networks.blend, one, belief)[:, *window])
