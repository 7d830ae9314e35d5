"""Laws of the camera's training steps."""

from dataclasses import replace

import numpy as np
import torch
from torch.nn import functional

from nvsf_core.fields.camera_networks import CameraNetworks
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.models.residual.camera_examples import LeftOut
from nvsf_core.models.residual.camera_step import camera_step, depth_step, sample_window
from nvsf_core.recipe import CameraSpec, ResidualRecipe, TrainingSpec
from nvsf_core.rendering.camera_view import camera_view, shown_images, shrinking
from nvsf_core.rendering.learned_warp import coarse_colour
from nvsf_core.rendering.lidar_view import lidar_view
from nvsf_core.rendering.plane_depth import likeliest_depth, plane_inverses, planes_of
from nvsf_core.rendering.view_depth_maps import DepthMaps
from nvsf_core.rendering.warping import to_float
from nvsf_core.training.loop import make_optimiser

CAMERA = Pinhole(fx=40.0, fy=40.0, cx=31.5, cy=15.5, width=64, height=32)
STEPS = TrainingSpec(steps=40, rays=600, parts=1, network_rate=5e-3)
RECIPE = replace(
    ResidualRecipe(name="tiny"),
    camera=CameraSpec(sources=2, planes=16, plane_px=64 * 32),
    depth_training=STEPS,
    camera_training=STEPS,
)


def poses() -> np.ndarray:
    result = np.tile(np.eye(4), (3, 1, 1))
    result[:, 0, 3] = (-0.4, 0.0, 0.4)
    return result


def example(spec: CameraSpec = RECIPE.camera, *, itself: bool = False) -> LeftOut:
    """A wall of stripes at 5 m, its middle photograph left out or `itself` a source; no LiDAR."""
    rays = CAMERA.rays(CAMERA.pixels())
    x = (rays / rays[..., 2:] * 5.0)[None, ..., 0] + poses()[:, None, None, 0, 3]
    images = np.stack([127 + 100 * np.sin(2.5 * x + phase) for phase in (0, 1, 2)], -1).astype(np.uint8)
    maps = DepthMaps(torch.full((3, 32, 64), 0.2), torch.zeros(3, 32, 64, dtype=torch.int16))
    shown = shown_images(images, np.ones((32, 64), np.bool_), shrinking(CAMERA, spec))
    nothing = lidar_view(poses()[1], CAMERA, np.zeros((0, 3), np.float32), ())
    view = camera_view(
        poses()[1], CAMERA, nothing, shown if itself else shown.with_depths(maps), poses(), spec,
        leave_out=() if itself else (1,), own=1 if itself else None,
    )  # fmt: skip
    truth = torch.from_numpy(images[1]).permute(2, 0, 1)
    full = to_float(images[1:2])
    coarse = None if itself else coarse_colour(view)
    return LeftOut(view, truth, functional.avg_pool2d(full, view.factor)[0], coarse)


def test_both_steps_lower_their_loss_and_the_sweep_learns_the_depth_of_the_wall() -> None:
    networks = CameraNetworks(RECIPE.camera, torch.Generator().manual_seed(0))
    itself, left_out, generator = example(itself=True), example(), torch.Generator().manual_seed(1)

    def descend(network, step) -> tuple[float, float]:
        optimiser, losses = make_optimiser(network, STEPS), []
        for _ in range(STEPS.steps):
            optimiser.zero_grad()
            loss = step()
            loss.total.backward()
            optimiser.step()
            losses.append(float(loss.total.detach()))
        return float(np.mean(losses[:5])), float(np.mean(losses[-5:]))

    before, after = descend(networks.depth, lambda: depth_step(networks.depth, [itself], RECIPE, generator))
    assert after < 0.8 * before
    with torch.no_grad():
        probability, _ = planes_of(networks.depth, itself.view, RECIPE.camera)
    middle = likeliest_depth(probability, plane_inverses(RECIPE.camera))[0][4:-4, 12:-12]
    assert abs(float(middle.median()) - 0.2) < 0.04
    before, after = descend(networks.blend, lambda: camera_step(networks, [left_out], RECIPE, generator))
    assert after < before


def test_windows_lie_in_the_image_and_are_as_large_as_asked_where_they_fit() -> None:
    generator = torch.Generator().manual_seed(0)
    for shape, pixels in (((40, 60), 600), ((10, 12), 5000), ((8, 200), 900)):
        rows, columns = sample_window(shape, pixels, generator)
        assert 0 <= rows.start < rows.stop <= shape[0] and 0 <= columns.start < columns.stop <= shape[1]
        area = (rows.stop - rows.start) * (columns.stop - columns.start)
        assert area == shape[0] * shape[1] or 0.9 * pixels < area <= pixels


def test_gradients_are_finite_with_a_place_holder_for_a_source() -> None:
    spec = replace(RECIPE.camera, sources=4)
    networks = CameraNetworks(spec, torch.Generator().manual_seed(0))
    camera_step(
        networks, [example(spec)], replace(RECIPE, camera=spec), torch.Generator().manual_seed(1)
    ).total.backward()
    gradient = networks.blend.out.weight.grad
    assert gradient is not None and torch.isfinite(gradient).all() and gradient.abs().sum() > 0
