import math

import numpy as np
import pytest

from nvsf_core.metrics.range_and_intensity import (
    intensity_image_metrics,
    range_image_metrics,
    ray_intensity_metrics,
    ray_range_metrics,
)


def test_one_wrong_drop_counts_with_its_whole_range() -> None:
    truth = np.full((10, 10), 60.0)
    truth[0, 0] = 50.0
    predicted = truth.copy()
    predicted[5, 5] = 0.0
    found = range_image_metrics(predicted, truth)
    assert found["range_rmse_m"].value == pytest.approx(math.sqrt(60.0**2 / 100), rel=1e-6)
    assert found["range_psnr_db"].value == pytest.approx(10 * math.log10(80**2 / 36.0), rel=1e-6)
    assert found["range_medae_m"].value == 0.0


def test_clamping_limits_both_sides_and_leaves_the_inputs_alone() -> None:
    truth, predicted = np.full((8, 8), 100.0), np.full((8, 8), 90.0)
    truth[0, 0] = predicted[0, 0] = 0.0
    assert range_image_metrics(predicted, truth)["range_rmse_m"].value == 0.0
    assert truth[0, 0] == 0.0
    assert truth[1, 1] == 100.0
    bright = np.full((8, 8), 3.0)
    assert intensity_image_metrics(bright, np.ones((8, 8)))["intensity_rmse"].value == 0.0
    assert bright[0, 0] == 3.0


def test_a_nan_pixel_is_undefined() -> None:
    truth = np.random.default_rng(0).random((8, 8))
    broken = truth.copy()
    broken[0, 0] = np.nan
    for found in (range_image_metrics(broken, truth), intensity_image_metrics(broken, truth)):
        assert all(math.isnan(measure.value) and measure.reason for measure in found.values())


def test_a_ray_without_an_answer_is_infinitely_wrong() -> None:
    truth = np.arange(1.0, 11.0)
    predicted = truth + 0.1
    predicted[3] = np.inf
    found = ray_range_metrics(predicted, truth)
    assert found["range_abs_error_median_m"].value == pytest.approx(0.1)
    assert found["range_abs_error_p90_m"].value == pytest.approx(0.1)
    assert found["range_missing"].value == pytest.approx(0.1)
    predicted[4] = np.inf
    assert math.isinf(ray_range_metrics(predicted, truth)["range_abs_error_p90_m"].value)
    lost = ray_range_metrics(np.full(10, np.inf), truth)
    assert math.isinf(lost["range_abs_error_median_m"].value)
    assert lost["range_missing"].value == 1.0


def test_nan_answers_and_no_rays_are_undefined() -> None:
    found = ray_range_metrics(np.array([np.nan]), np.ones(1))
    assert "1 predicted ranges are NaN" in found["range_missing"].reason
    assert math.isnan(ray_range_metrics(np.zeros(0), np.zeros(0))["range_missing"].value)


def test_intensity_along_rays_rests_on_the_answered_ones() -> None:
    answered = np.array([True, True, False])
    found = ray_intensity_metrics(np.array([0.5, 0.5, 0.0]), np.array([0.4, 0.6, 1.0]), answered)
    assert found["intensity_rmse"].value == pytest.approx(0.1)
    assert found["intensity_rmse"].n_valid == 2
    nothing = ray_intensity_metrics(np.zeros(3), np.ones(3), np.zeros(3, dtype=bool))
    assert math.isnan(nothing["intensity_rmse"].value)
