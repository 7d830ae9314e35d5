"""A model that was just trained is judged: its weights, its loss, and a training scan rendered by it."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from nvsf_core.drives.catalogue import load_catalogue
from nvsf_core.models.baselines.reproject import reprojection
from nvsf_core.rendering.rendered import RenderedRays
from nvsf_core.stages import plan_run, run_named_stage
from nvsf_core.stages.checks.field import check_loss, check_rendering, check_weights
from nvsf_core.stages.inputs import read_recording

UP_TO_EVIDENCE = ("frames", "sweeps", "pano", "undistorted", "evidence")


@pytest.fixture(scope="module")
def recording(tiny_catalogue, tmp_path_factory):
    entry = next(one for one in load_catalogue([tiny_catalogue], None) if one.name == "tiny")
    run = plan_run(entry, tmp_path_factory.mktemp("home"), recipe="smoke")
    for name in UP_TO_EVIDENCE:
        run_named_stage(name, run, lambda _: None)
    return read_recording(run.store)


def _answering(**values):
    """A LiDAR that answers every ray alike."""

    def answer(origin_m, direction, hit_prior, time_s):
        columns = {"range_m": 10.0, "hit": 1.0, "intensity": 0.5} | values
        return RenderedRays(**{k: np.full(len(hit_prior), value, np.float32) for k, value in columns.items()})

    return answer


def _judged(recording, **values):
    model = replace(reprojection(recording), lidar=_answering(**values))
    return {check.name: check for check in check_rendering(model, recording)}


def test_what_the_drive_proves_is_within_limits(recording):
    found = {check.name: check for check in check_rendering(reprojection(recording), recording)}
    assert found["training_scan_is_rendered_within_limits"].passed
    assert all(check.value is not None for check in found.values())


@pytest.mark.parametrize(
    ("what", "value"),
    [("range_m", math.nan), ("range_m", 1e4), ("hit", math.nan), ("hit", 1.5), ("intensity", math.nan)],
)
def test_a_model_that_answers_nonsense_is_not_published(recording, what, value):
    check = _judged(recording, **{what: value})["training_scan_is_rendered_within_limits"]
    assert not check.passed and check.blocking and "out of limits" in check.detail


def test_a_model_that_drops_every_ray_is_doubted(recording):
    found = _judged(recording, hit=0.0)
    assert found["training_scan_is_rendered_within_limits"].passed
    rate = found["hit_rate_is_as_trained"]
    assert not rate.passed and not rate.blocking and rate.value > 0.5 > rate.limit


def test_a_model_of_one_grey_is_doubted(recording):
    assert not _judged(recording)["intensities_are_as_trained"].passed


def test_a_drive_without_lidar_is_not_judged_by_scans(recording):
    found = check_rendering(reprojection(recording), replace(recording, lidar=None))
    assert [check.passed for check in found] == [True] * 3
    assert all(check.detail.startswith("not run") for check in found)


@pytest.mark.parametrize("broken", [math.nan, math.inf])
def test_a_broken_weight_is_named(broken):
    check = check_weights(
        {"lidar.grid": torch.tensor([1.0, broken, 0.0, 0.0]), "camera.bias": torch.zeros(4)}
    )
    assert not check.passed and check.blocking and check.value == pytest.approx(1 / 8)
    assert "1 in lidar.grid" in check.detail and "camera" not in check.detail


def test_noise_of_single_batches_is_no_rising_loss():
    falling = [{"loss": 1.0 - 0.01 * step} for step in range(50)]
    assert check_loss({"lidar": [{"loss": 0.1}, *falling, {"loss": 3.0}]}).passed
    assert not check_loss({"lidar": falling, "camera": falling[::-1]}).passed
    assert check_loss({"lidar": falling[:1]}).detail.startswith("not run")


def test_a_loss_that_scatters_about_its_best_holds_and_one_that_rises_above_its_scatter_does_not():
    scatter = 0.02 + 0.01 * np.random.default_rng(0).standard_normal(60)
    assert check_loss({"hits": [{"loss": value} for value in scatter]}).passed
    assert check_loss({"hits": [{"loss": value} for value in scatter[::-1]]}).passed
    risen = scatter + np.linspace(0.0, 0.05, 60)
    assert not check_loss({"hits": [{"loss": value} for value in risen]}).passed


def test_a_loss_that_is_not_a_number_does_not_hold():
    assert not check_loss({"lidar": [{"loss": 1.0}, {"loss": math.nan}]}).passed
