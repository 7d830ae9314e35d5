"""An image is blank, or unlike the recorded ones, by the training images of its own camera alone."""

import numpy as np
import pytest

from nvsf_core.errors import DataError
from nvsf_core.metrics.norms import LEAST_LEVELS, image_norms

HIGH, WIDE = 20, 30
ALL = np.ones((HIGH, WIDE), np.bool_)


def _images(count: int, least: int = 0, most: int = 256, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(least, most, (count, HIGH, WIDE, 3), np.uint8)


def test_a_recorded_image_is_neither_blank_nor_unlike() -> None:
    images = _images(4)
    norms = image_norms(images, ALL)
    assert all(norms.deviation_of(image) >= norms.blank_below for image in images)
    assert [norms.greys_apart(image) for image in images] == [0.0] * 4


@pytest.mark.parametrize("level", [0, 128, 255])
def test_one_grey_is_blank_and_unlike(level: int) -> None:
    norms, image = image_norms(_images(4), ALL), np.full((HIGH, WIDE, 3), level, np.uint8)
    assert norms.deviation_of(image) == pytest.approx(0.0, abs=1e-9)
    assert norms.blank_below >= LEAST_LEVELS
    assert norms.greys_apart(image) > norms.greys_limit


def test_the_deviation_is_that_of_the_grey_values_in_levels() -> None:
    image = np.zeros((HIGH, WIDE, 3), np.uint8)
    image[: HIGH // 2] = 100  # half at 0, half at 100: 50 levels from the mean
    assert image_norms(image[None], ALL).deviation_of(image) == pytest.approx(50.0)


def test_a_camera_that_records_one_grey_does_not_excuse_it() -> None:
    norms = image_norms(np.full((3, HIGH, WIDE, 3), 200, np.uint8), ALL)
    assert norms.blank_below == LEAST_LEVELS


def test_only_valid_pixels_are_looked_at() -> None:
    valid = ALL.copy()
    valid[:, : WIDE // 2] = False
    images = _images(3)
    changed = images.copy()
    changed[:, ~valid] = 0
    assert np.array_equal(image_norms(images, valid).deviation, image_norms(changed, valid).deviation)


def test_of_many_pixels_evenly_spaced_ones_tell_the_same() -> None:
    rng = np.random.default_rng(1)
    images = np.repeat(rng.integers(0, 256, (2, 400, 600, 1), np.uint8), 3, axis=-1)
    norms = image_norms(images, np.ones((400, 600), np.bool_))
    assert norms.seen.sum() < 50_000
    assert norms.deviation == pytest.approx([float(image[..., 0].std()) for image in images], rel=0.02)


def test_nothing_to_look_at_is_an_error() -> None:
    with pytest.raises(DataError, match="found 0 images"):
        image_norms(_images(0), ALL)
    with pytest.raises(DataError, match="0 valid pixels"):
        image_norms(_images(1), ~ALL)
