"""Laws of the depth network's training steps."""

from dataclasses import replace

import numpy as np
import torch
from torch.nn import functional

from nvsf_core.fields.depth_network import DepthNetwork
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.models.residual.camera_examples import RecordedView
from nvsf_core.models.residual.depth_step import depth_step, sample_window
from nvsf_core.recipe.residual import CameraSpec, ResidualRecipe, TrainingSpec
from nvsf_core.rendering.camera_view import camera_view, shown_images, shrinking
from nvsf_core.rendering.lidar_view import lidar_view
from nvsf_core.rendering.plane_depth import likeliest_depth, plane_inverses, planes_of
from nvsf_core.rendering.warping import to_float
from nvsf_core.training.loop import make_optimiser

CAMERA = Pinhole(fx=40.0, fy=40.0, cx=31.5, cy=15.5, width=64, height=32)
STEPS = TrainingSpec(steps=40, rays=600, parts=1, network_rate=5e-3)
RECIPE = replace(
    ResidualRecipe(name="tiny"),
    camera=CameraSpec(sources=2, planes=16, plane_px=64 * 32),
    depth_training=STEPS,
)


def poses() -> np.ndarray:
    result = np.tile(np.eye(4), (3, 1, 1))
    result[:, 0, 3] = (-0.4, 0.0, 0.4)
    return result


def example(spec: CameraSpec = RECIPE.camera) -> RecordedView:
    """A wall of stripes at 5 m, its middle photograph the first source; no LiDAR."""
    rays = CAMERA.rays(CAMERA.pixels())
    x = (rays / rays[..., 2:] * 5.0)[None, ..., 0] + poses()[:, None, None, 0, 3]
    images = np.stack([127 + 100 * np.sin(2.5 * x + phase) for phase in (0, 1, 2)], -1).astype(np.uint8)
    shown = shown_images(images, np.ones((32, 64), np.bool_), shrinking(CAMERA, spec))
    nothing = lidar_view(poses()[1], CAMERA, np.zeros((0, 3), np.float32), ())
    view = camera_view(poses()[1], CAMERA, nothing, shown, poses(), spec, own=1)
    return RecordedView(view, functional.avg_pool2d(to_float(images[1:2]), view.factor)[0])


def test_steps_lower_their_loss_and_the_network_learns_the_depth_of_the_wall() -> None:
    network = DepthNetwork(RECIPE.camera, torch.Generator().manual_seed(0))
    one, generator, losses = example(), torch.Generator().manual_seed(1), []
    optimiser = make_optimiser(network, STEPS)
    for _ in range(STEPS.steps):
        optimiser.zero_grad()
        loss = depth_step(network, [one], RECIPE, generator)
        loss.total.backward()
        optimiser.step()
        losses.append(float(loss.total.detach()))
    assert np.mean(losses[-5:]) < 0.8 * np.mean(losses[:5])
    with torch.no_grad():
        probability, _ = planes_of(network, one.view, RECIPE.camera)
    middle = likeliest_depth(probability, plane_inverses(RECIPE.camera))[0][4:-4, 12:-12]
    assert abs(float(middle.median()) - 0.2) < 0.04


def test_windows_lie_in_the_image_and_are_as_large_as_asked_where_they_fit() -> None:
    generator = torch.Generator().manual_seed(0)
    for shape, pixels in (((40, 60), 600), ((10, 12), 5000), ((8, 200), 900)):
        rows, columns = sample_window(shape, pixels, generator)
        assert 0 <= rows.start < rows.stop <= shape[0] and 0 <= columns.start < columns.stop <= shape[1]
        area = (rows.stop - rows.start) * (columns.stop - columns.start)
        assert area == shape[0] * shape[1] or 0.9 * pixels < area <= pixels


def test_gradients_are_finite_with_a_place_holder_for_a_source() -> None:
    spec = replace(RECIPE.camera, sources=4)
    network = DepthNetwork(spec, torch.Generator().manual_seed(0))
    depth_step(
        network, [example(spec)], replace(RECIPE, camera=spec), torch.Generator().manual_seed(1)
    ).total.backward()
    gradient = network.prior.weight.grad
    assert gradient is not None and torch.isfinite(gradient).all() and gradient.abs().sum() > 0
