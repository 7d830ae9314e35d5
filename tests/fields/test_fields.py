"""Laws of the residual fields."""

import numpy as np
import pytest
import torch

from nvsf_core.evidence.surfels import build_surfels
from nvsf_core.fields.lidar_field import LidarField, surface_batch
from nvsf_core.geometry.bounds import Bounds
from nvsf_core.recipe.residual import FieldSpec
from nvsf_core.rendering.lidar import render_lidar, render_rays
from nvsf_core.rendering.reproject import reproject_rays

BOUNDS = Bounds(centre_m=(0.0, 0.0, 0.0), half_m=20.0)
SPEC = FieldSpec(levels=3, log2_table=10)


@pytest.fixture(scope="module")
def scene():
    """Surfels of a noisy wall, and rays that look at it."""
    rng = np.random.default_rng(0)
    direction = np.stack([np.ones(4000), rng.uniform(-0.2, 0.2, 4000), rng.uniform(-0.1, 0.1, 4000)], axis=1)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    range_m = 8.0 / direction[:, 0] + rng.normal(0, 0.01, 4000)
    origin = np.zeros((4000, 3), np.float32)
    surfels = build_surfels(
        origin,
        direction.astype(np.float32),
        range_m.astype(np.float32),
        np.full(4000, 0.3),
        voxel_m=0.2,
    )
    return surfels, origin[:64], direction[:64].astype(np.float32)


def test_an_untrained_field_answers_as_the_evidence_does(scene) -> None:
    surfels, origin, direction = scene
    field = LidarField(SPEC, BOUNDS, torch.Generator().manual_seed(0))
    batch = surface_batch(surfels, origin, direction, most=8, near_m=0.5, far_m=50.0)
    hit_prior = np.linspace(0.1, 0.9, 64).astype(np.float32)
    learned = render_rays(field, batch, torch.from_numpy(hit_prior))
    proven = reproject_rays(surfels, origin, direction, hit_prior, most=8, far_m=50.0)
    assert np.allclose(learned.range_m, proven.range_m, atol=1e-4)
    assert np.allclose(learned.hit, proven.hit, atol=1e-5)
    assert np.allclose(learned.intensity, proven.intensity, atol=1e-4)


def test_every_parameter_of_the_lidar_field_receives_a_gradient(scene) -> None:
    surfels, origin, direction = scene
    field = LidarField(SPEC, BOUNDS, torch.Generator().manual_seed(0))
    with torch.no_grad():
        for parameter in field.parameters():  # silent outputs hide what lies before them
            parameter += 0.01 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(1))
    rendered = render_lidar(
        field,
        surface_batch(surfels, origin, direction, most=8, near_m=0.5, far_m=50.0),
        torch.full((64,), 0.5),
    )
    (rendered.weights * rendered.range_m).sum().add(
        rendered.hit_logit.sum() + rendered.intensity_logit.sum()
    ).backward()
    for name, parameter in field.named_parameters():
        assert parameter.grad is not None and torch.isfinite(parameter.grad).all(), name
        assert parameter.grad.abs().sum() > 0, name


def test_a_ray_without_any_surface_has_finite_gradients(scene) -> None:
    surfels, origin, direction = scene
    field = LidarField(SPEC, BOUNDS, torch.Generator().manual_seed(0))
    batch = surface_batch(surfels, origin, -direction, most=8, near_m=0.5, far_m=50.0)
    assert not batch.is_there.any()
    rendered = render_lidar(field, batch, torch.full((64,), 0.5))
    rendered.hit_logit.sum().backward()
    assert all(p.grad is None or torch.isfinite(p.grad).all() for p in field.parameters())
