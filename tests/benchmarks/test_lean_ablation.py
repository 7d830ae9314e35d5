"""Variants of `lean`: the first is its own training."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.lean.ablation import VARIANTS, helps, make_field, read_rows
from benchmarks.lean.variants import PATCH, RayGrid, Variant, VariantStep, huber_depth_loss, ray_grid
from nvsf_core.drives.catalogue import load_catalogue
from nvsf_core.losses.lidar import depth_loss
from nvsf_core.metrics.table import BASELINES
from nvsf_core.models.residual.lidar import lidar_step
from nvsf_core.models.residual.training_rays import LidarRays, training_rays
from nvsf_core.recipe import ResidualRecipe, TrainingSpec, preset
from nvsf_core.recording.drive import LidarRecording
from nvsf_core.stages import run_named_stage
from nvsf_core.stages.inputs import read_recording
from nvsf_core.stages.runner.run import plan_run

Made = tuple[LidarRecording, ResidualRecipe, LidarRays, RayGrid]


@pytest.fixture(scope="module")
def made(tiny_catalogue: Path, tmp_path_factory: pytest.TempPathFactory) -> Made:
    scene = next(entry for entry in load_catalogue([tiny_catalogue], None) if entry.name == "tiny")
    run = plan_run(scene, tmp_path_factory.mktemp("ablation"), recipe="smoke")
    for stage in ("frames", "undistorted", "sweeps", "evidence"):
        run_named_stage(stage, run, lambda _: None)
    lidar, recipe = read_recording(run.store).lidar, preset("smoke")
    assert lidar is not None and isinstance(recipe, ResidualRecipe)
    recipe = replace(recipe, lidar_training=TrainingSpec(steps=1, rays=128))
    rays = training_rays(lidar, recipe, make_field(lidar, recipe, VARIANTS[0], 0))
    return lidar, recipe, rays, ray_grid(lidar, rays)


def step_of(made: Made, variant: Variant) -> VariantStep:
    lidar, recipe, rays, grid = made
    field = make_field(lidar, recipe, variant, 0)
    return VariantStep(variant, field, lidar.evidence.static, rays, recipe, lidar.far_m, grid)


def test_the_first_variant_is_the_recipes_own_training(made):
    lidar, recipe, rays, _ = made
    step = step_of(made, VARIANTS[0])
    drawn = torch.Generator().manual_seed(3)
    own = lidar_step(
        step.field, lidar.evidence.static, rays, recipe, lidar.far_m, torch.Generator().manual_seed(3)
    )
    (other,) = step(0, drawn)
    assert torch.equal(own.total, other.total)
    assert own.terms == other.terms


def test_every_table_on_record_carries_what_learns_nothing():
    rows = read_rows()
    for place in {(row["scene"], row["steps"]) for row in rows}:
        assert set(BASELINES) <= {row["variant"] for row in rows if (row["scene"], row["steps"]) == place}


def test_nearly_every_training_ray_lies_in_the_grid_beside_its_neighbours(made):
    _, _, rays, grid = made
    there = grid.ray >= 0
    assert len(np.unique(grid.ray[there])) == there.sum() >= 0.98 * len(rays)
    np.testing.assert_array_equal(grid.range_m.numpy()[there], rays.range_m[grid.ray[there]])
    both = there[:, :-1] & there[:, 1:]
    left, right = (rays.direction[grid.ray[cut][both]] for cut in (np.s_[:, :-1], np.s_[:, 1:]))
    step_rad = 2.0 * np.pi / grid.ray.shape[1]
    angle_rad = np.arccos(np.clip(np.einsum("ni,ni->n", left, right), -1.0, 1.0))
    assert np.quantile(angle_rad, 0.95) < 2.0 * step_rad


def test_ranges_are_compared_within_a_scan_between_rays_that_are_trained(made):
    grid = made[3]
    there = grid.is_ray
    last = torch.arange(len(there)) % grid.lasers == grid.lasers - 1
    assert grid.mask_x.any() and grid.mask_y.any()
    assert not grid.mask_y[last].any()
    assert bool(there[:, 1:][grid.mask_x[:, :-1]].all()) and not grid.mask_x[:, -1].any()
    assert bool(there[1:][grid.mask_y[:-1]].all())


@pytest.mark.parametrize("name", ["heuristic sampling", "heuristic patches, L_grad x 1"])
def test_an_error_map_turns_draws_towards_what_was_wrong(made, name):
    step = step_of(made, next(variant for variant in VARIANTS if variant.name == name))
    assert step.errors is not None
    rows = step.errors.errors.shape[1] // 2
    step.errors.errors[0, :rows], step.errors.errors[0, rows:] = 1e-6, 1.0
    row, _ = step._cells(torch.Generator().manual_seed(0))
    assert (row >= 2 * rows - PATCH[0]).all()
    (loss,) = step(0, torch.Generator().manual_seed(0))
    assert torch.isfinite(loss.total)
    assert step.errors.errors.max() > 1.0


def test_the_gradient_loss_is_part_of_every_second_step_and_reaches_the_field(made):
    step = step_of(made, next(variant for variant in VARIANTS if variant.name == "patches, L_grad x 1"))
    generator = torch.Generator().manual_seed(0)
    (with_patches,), (without,) = step(0, generator), step(1, generator)
    assert "gradient" in with_patches.terms and "gradient" not in without.terms
    with_patches.reduced["gradient"].backward()
    found = [p.grad for p in step.field.parameters() if p.grad is not None]
    assert any(bool(gradient.abs().sum() > 0) for gradient in found)


def test_small_errors_count_squared_and_large_ones_as_before():
    one, at_m = torch.ones(3, 1), torch.tensor([[10.01], [10.05], [11.0]])
    true_m = torch.full((3,), 10.0)
    smooth, plain = huber_depth_loss(one, at_m, true_m, 0.05), depth_loss(one, at_m, true_m)
    np.testing.assert_allclose(smooth, [0.001, 0.025, 0.975], atol=1e-5)
    assert bool((smooth < plain).all())


def test_a_variant_helps_only_beyond_the_spread_of_the_seeds():
    base = [{"seed": 0, "f_score": 0.90}, {"seed": 1, "f_score": 0.92}]
    near = [{"seed": 0, "f_score": 0.91}, {"seed": 1, "f_score": 0.93}]
    far = [{"seed": 0, "f_score": 0.94}, {"seed": 1, "f_score": 0.95}]
    assert not helps(near, base, "f_score")
    assert helps(far, base, "f_score")
    assert not helps(far[:1], base, "f_score")
