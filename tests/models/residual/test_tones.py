"""Laws of bringing images to the look of another camera."""

import numpy as np

from nvsf_core.models.residual.tones import ToneCurve, tone_curve

CURVE = ToneCurve((0.7, 0.75, 0.8), (1.1, 1.05, 0.95))


def images(seed: int) -> np.ndarray:
    """Two images, bright and dark; another seed, as another camera, sees other pixels of the same scene."""
    levels = np.random.default_rng(seed).beta(2.0, 2.0, (2, 96, 128, 3)) * 220.0 + 15.0
    return levels.astype(np.uint8)


def test_images_of_the_same_look_are_left_alone() -> None:
    assert tone_curve(images(0), images(1)) is None


def test_another_exposure_and_contrast_are_found_without_any_correspondence() -> None:
    seen = images(0)
    curve = tone_curve(CURVE.of(seen), images(1))
    assert curve is not None
    off = np.abs(curve.of(CURVE.of(seen)).astype(int) - seen)
    assert np.abs(CURVE.of(seen).astype(int) - seen).mean() > 20.0
    assert off.mean() < 2.0 and off.max() <= 6


def test_the_way_back_leads_back() -> None:
    seen = images(2)
    there = CURVE.of(seen)
    assert np.abs(CURVE.inverse().of(there).astype(int) - seen).max() <= 2


def test_images_without_contrast_tell_nothing() -> None:
    dark = np.full((2, 32, 32, 3), 1, np.uint8)
    assert tone_curve(dark, images(0)) is None and tone_curve(images(0), dark) is None
    grey = np.full((2, 32, 32, 3), 100, np.uint8)
    assert tone_curve(grey, images(0)) is None


def test_a_few_lamps_by_night_tell_nothing_of_all_the_rest() -> None:
    night = np.zeros((2, 96, 128, 3), np.uint8)
    left, right = night.copy(), night.copy()
    left[:, :8], right[:, :7] = 120, 40
    left[:, 8:12], right[:, 7:10] = 200, 90
    assert tone_curve(left, right) is None and tone_curve(right, left) is None
