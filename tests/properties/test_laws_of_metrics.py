"""Laws of what scores and samples: clouds, images, boxes, schedules; references in float64 and scipy."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist

from benchmarks.numerics.cases.tolerances import EPS, LENGTH_M, SUM_EPS
from nvsf_core.geometry.bounds import Bounds
from nvsf_core.geometry.voxels import index_points
from nvsf_core.losses.chamfer import squared_nearest_distances
from nvsf_core.metrics.elementwise import median_abs_error, psnr, rmse
from nvsf_core.metrics.point_cloud import F_THRESHOLD_M2, point_cloud_metrics
from nvsf_core.models.paper.refine import one_cycle

LAW = settings(derandomize=True, deadline=None, max_examples=40, database=None)
seeds = st.integers(0, 2**32 - 1)
scales = st.sampled_from([1e-3, 1.0, 80.0])


def _cloud(seed: int, count: int, scale_m: float) -> np.ndarray:
    return np.random.default_rng(seed).normal(0.0, scale_m, (count, 3))


@LAW
@given(seeds, st.integers(1, 40), st.integers(1, 40), scales, st.sampled_from([0.0, 3.8e3]))
def test_clouds_are_as_far_apart_as_all_their_pairs_say(
    seed: int, n: int, m: int, scale_m: float, shift_m: float
) -> None:
    predicted, truth = _cloud(seed, n, scale_m) + shift_m, _cloud(seed + 1, m, scale_m) + shift_m
    found, swapped = point_cloud_metrics(predicted, truth), point_cloud_metrics(truth, predicted)
    square = cdist(predicted, truth, "sqeuclidean")
    chamfer = square.min(axis=1).mean() + square.min(axis=0).mean()
    assert found["chamfer_m2"].value == pytest.approx(chamfer, rel=1e-9, abs=LENGTH_M**2)
    assert found["chamfer_m2"].value == pytest.approx(swapped["chamfer_m2"].value, rel=1e-12)
    precision, recall = ((square.min(axis=k) < F_THRESHOLD_M2).mean() for k in (1, 0))
    expected = 2 * precision * recall / (precision + recall) if precision + recall else 0.0
    assert found["f_score"].value == pytest.approx(expected) and 0.0 <= found["f_score"].value <= 1.0


@LAW
@given(seeds, st.integers(1, 40), st.integers(1, 40), scales)
def test_the_chamfer_loss_is_that_of_all_pairs_and_its_gradient_is_finite(
    seed: int, n: int, m: int, scale_m: float
) -> None:
    points = torch.from_numpy(_cloud(seed, n, scale_m)).float().requires_grad_()
    others = torch.from_numpy(_cloud(seed + 1, m, scale_m)).float()
    there, back = squared_nearest_distances(points, others)
    square = cdist(points.detach().double().numpy(), others.double().numpy(), "sqeuclidean")
    for found, exact in ((there, square.min(axis=1)), (back, square.min(axis=0))):
        assert np.abs(found.detach().numpy() - exact).max() <= SUM_EPS * EPS * (exact.max() + 1e-12)
    (there.sum() + back.sum()).backward()
    assert points.grad is not None and torch.isfinite(points.grad).all()


@LAW
@given(seeds, st.integers(1, 200), st.floats(1e-6, 1e6), st.floats(-1e3, 1e3))
def test_errors_scale_with_their_unit_and_do_not_see_an_offset(
    seed: int, n: int, unit: float, offset: float
) -> None:
    rng = np.random.default_rng(seed)
    truth = rng.uniform(0.0, 1.0, n)
    predicted = truth + rng.normal(0.0, 0.1, n)
    error = np.abs(predicted - truth)
    for measure, exact in ((rmse, math.sqrt(np.mean(error**2))), (median_abs_error, float(np.median(error)))):
        assert measure(predicted, truth).value == pytest.approx(exact, rel=1e-9)
        assert measure(predicted * unit, truth * unit).value == pytest.approx(exact * unit, rel=1e-6)
        assert measure(predicted + offset, truth + offset).value == pytest.approx(exact, rel=1e-6, abs=1e-12)
    assert psnr(predicted * unit, truth * unit, unit).value == pytest.approx(
        -20.0 * math.log10(math.sqrt(np.mean(error**2))), abs=1e-6
    )


@LAW
@given(seeds, st.integers(1, 300), st.sampled_from([0.1, 0.2, 1.0]), st.sampled_from([0.0, 1234.5]))
def test_points_share_a_voxel_exactly_where_their_floors_are_equal(
    seed: int, n: int, voxel_m: float, shift_m: float
) -> None:
    points = _cloud(seed, n, 2.0) + shift_m
    index, voxel = index_points(points, voxel_m)
    _, exact = np.unique(np.floor((points - index.origin_m) / voxel_m), axis=0, return_inverse=True)
    assert index.voxel_count == exact.max() + 1 and voxel.min() >= 0 and voxel.max() < index.voxel_count
    pairs = {(int(a), int(b)) for a, b in zip(voxel, exact.ravel(), strict=True)}
    assert len(pairs) == index.voxel_count


@LAW
@given(seeds, st.integers(2, 100), st.floats(0.1, 500.0), st.sampled_from([1.0, 2.0]))
def test_a_box_leads_to_its_units_and_back(seed: int, n: int, scale_m: float, bound: float) -> None:
    points = _cloud(seed, n, scale_m)
    bounds = Bounds.of_points(points, outermost_share=0.0, bound=bound)
    wide = torch.from_numpy(points)
    scaled = bounds.to_scaled(wide)
    assert scaled.abs().max() <= 1.0 + 1e-12
    assert (bounds.to_metres(scaled) - wide).abs().max() <= LENGTH_M
    unit = bounds.to_unit(wide)
    assert ((unit >= -1e-12) & (unit <= 1.0 + 1e-12)).all()


@LAW
@given(st.integers(10, 80), st.floats(1e-6, 1.0))
def test_the_one_cycle_is_torchs_own(steps: int, highest: float) -> None:
    parameter = torch.nn.Parameter(torch.zeros(1))
    optimiser = torch.optim.Adam([parameter], lr=highest)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, highest, total_steps=steps)
    optimiser.step()
    for step in range(steps):
        rate, beta = one_cycle(step, steps, highest)
        group = optimiser.param_groups[0]
        assert rate == pytest.approx(group["lr"], rel=1e-9) and 0.0 < rate <= highest * (1.0 + 1e-12)
        assert beta == pytest.approx(group["betas"][0], rel=1e-12)
        if step + 1 < steps:
            schedule.step()
