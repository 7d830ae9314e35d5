import math

import numpy as np
import pytest

from nvsf_core.metrics.ssim import ssim


def _pair(shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    truth = rng.random(shape).cumsum(axis=1) % 1.0
    return np.clip(truth + rng.normal(0, 0.1, shape), 0, 1), truth


def test_equals_scikit_image_default() -> None:
    oracle = pytest.importorskip("skimage.metrics").structural_similarity
    for shape, scale in (((66, 103), 80.0), ((40, 30), 1.0), ((7, 7), 1.0)):
        predicted, truth = (scale * image for image in _pair(shape))
        expected = oracle(truth, predicted, data_range=float(np.ptp(truth)))
        assert ssim(predicted, truth, float(np.ptp(truth))).value == pytest.approx(expected, abs=1e-12)
    predicted, truth = _pair((30, 40, 3))
    expected = oracle(truth, predicted, data_range=1.0, channel_axis=2)
    assert ssim(predicted, truth, 1.0).value == pytest.approx(expected, abs=1e-12)


def test_equal_images_score_one_and_worse_ones_less() -> None:
    predicted, truth = _pair((20, 20))
    assert ssim(truth, truth, 1.0).value == pytest.approx(1.0)
    assert ssim(predicted, truth, 1.0).value < 1.0


def test_invalid_pixels_never_matter() -> None:
    predicted, truth = _pair((30, 30, 3))
    valid = np.ones((30, 30), dtype=bool)
    valid[:, :8] = False
    garbled = predicted.copy()
    garbled[:, :8] = 0.7
    masked = ssim(garbled, truth, 1.0, valid)
    assert masked.value == pytest.approx(ssim(predicted[:, 8:], truth[:, 8:], 1.0).value, abs=1e-9)
    assert masked.n_valid == (30 - 6) * (22 - 6)


def test_constant_truth_small_images_and_full_masks_are_undefined() -> None:
    ones = np.ones((20, 20))
    assert math.isnan(ssim(ones, ones, 0.0).value)
    assert math.isnan(ssim(ones[:6], ones[:6], 1.0).value)
    assert math.isnan(ssim(ones, ones, 1.0, np.zeros((20, 20), dtype=bool)).value)
