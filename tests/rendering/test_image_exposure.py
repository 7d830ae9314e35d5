"""Laws of exposures, on photographs of a room's corner that were taken at other ones."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nvsf_core.rendering.image_exposure import at_exposure, log_gains, recorded_at_exposure
from tests.rendering.corner import CAMERA, COUNT, RGB, SEEN, TRUE

GAINS = st.floats(-1.0, 1.0)
LEVELS = torch.linspace(0.0, 1.0, 256, dtype=torch.float64)
RETURNS_M = [point[1::3, 1::3].reshape(-1, 3) for point, _ in SEEN]


def _taken_with(log_gain: np.ndarray) -> np.ndarray:
    """The photographs, taken with these gains."""
    levels = (
        at_exposure(torch.from_numpy(image) / 255.0, float(gain))
        for image, gain in zip(RGB, log_gain, strict=True)
    )
    return np.stack([(255.0 * one).round().to(torch.uint8).numpy() for one in levels])


@given(GAINS, GAINS)
def test_black_and_white_stay_and_gains_after_each_other_are_one(first: float, second: float) -> None:
    once = at_exposure(LEVELS, first)
    assert once[0] == 0.0 and once[-1].item() == pytest.approx(1.0)
    assert (once.diff() > 0.0).all(), "what was brighter stays brighter"
    both = at_exposure(LEVELS, first + second)
    assert torch.allclose(at_exposure(once, second), both, atol=1e-6)


@given(GAINS)
def test_dark_levels_are_multiplied(log_gain: float) -> None:
    dark = 0.3 * min(1.0, math.exp(-log_gain)) * LEVELS
    assert torch.allclose(at_exposure(dark, log_gain), math.exp(log_gain) * dark, rtol=1e-3)


def test_gains_of_images_are_found_up_to_a_common_one() -> None:
    true = np.array([0.0, 0.05, -0.15, -0.1, 0.2, 0.1])
    found = log_gains(_taken_with(true), CAMERA, TRUE, RETURNS_M)
    assert found - found.mean() == pytest.approx(true - true.mean(), abs=0.01)
    assert abs(found.mean()) < 0.01


def test_images_of_one_exposure_have_no_gain() -> None:
    assert np.abs(log_gains(RGB, CAMERA, TRUE, RETURNS_M)).max() < 0.005


def test_an_image_that_shares_no_returns_with_another_says_nothing() -> None:
    nothing = [np.zeros((0, 3), np.float32)] * COUNT
    assert not log_gains(RGB, CAMERA, TRUE, nothing).any()
    assert not log_gains(RGB[:1], CAMERA, TRUE[:1], RETURNS_M[:1]).any()
    away = TRUE.copy()
    away[-1, 2, 3] = -1e3
    found = log_gains(_taken_with(np.array([0.0, 0.1, 0.0, 0.1, 0.0, 0.4])), CAMERA, away, RETURNS_M)
    assert found[-1] == pytest.approx(0.0, abs=1e-9)


def test_glare_and_darkness_tell_nothing() -> None:
    for level in (3, 252):
        images = np.full_like(RGB, level)
        assert not log_gains(images, CAMERA, TRUE, RETURNS_M).any()


@pytest.mark.parametrize("log_gain", [-0.4, 0.0, 0.3])
def test_recorded_levels_are_changed_as_any_others(log_gain: float) -> None:
    image = np.random.default_rng(0).integers(0, 256, (5, 7, 3), np.uint8)
    expected = at_exposure(torch.from_numpy(image).permute(2, 0, 1) / 255.0, log_gain)
    torch.testing.assert_close(recorded_at_exposure(image, log_gain), expected)
