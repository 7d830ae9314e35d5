import numpy as np
import pytest

from nvsf_core.errors import DataError
from nvsf_core.metrics.trust.likeness_classifier import distinguished, image_features, scan_features


def _textured(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (64, 128, 3)).astype(np.uint8)


def test_two_samples_of_one_kind_cannot_be_distinguished_and_shifted_ones_can() -> None:
    draws = np.random.default_rng(0)
    one, other = draws.normal(size=(2, 400, 3))
    assert distinguished(one, other) < 0.6
    assert distinguished(one, np.add(other, [0.0, 4.0, 0.0])) > 0.98
    assert 0.7 < distinguished(one, np.add(other, [0.0, 1.0, 0.0])) < 0.9
    # The same mean, another spread.
    assert distinguished(one, 4.0 * other) > 0.9


def test_the_score_is_of_patches_that_were_not_learned_from() -> None:
    draws = np.random.default_rng(1)
    one, other = draws.normal(size=(2, 40, 12))
    assert distinguished(one, other) < 0.75


def test_a_blurred_image_is_told_from_sharp_ones_and_a_sharp_one_is_not() -> None:
    valid = np.ones((64, 128), bool)
    recorded, again = (image_features(_textured(seed), valid) for seed in (1, 2))
    image = _textured(3).astype(np.float64)
    blurred = np.mean([np.roll(image, (k, j), (0, 1)) for k in range(3) for j in range(3)], axis=0)
    assert distinguished(again, recorded) < 0.7
    assert distinguished(image_features(blurred.astype(np.uint8), valid), recorded) > 0.99


def test_patches_outside_the_lens_and_without_returns_are_left_out() -> None:
    valid = np.ones((64, 128), bool)
    valid[:16, :16] = False
    assert len(image_features(_textured(0), valid)) == 4 * 8 - 1
    range_m = np.full((16, 64), 10.0)
    range_m[:8, :32] = 0.0
    features = scan_features(range_m, np.full((16, 64), 0.3))
    assert features.shape == (3, 6) and np.isfinite(features).all()
    assert features[:, 0].tolist() == [1.0, 1.0, 1.0]


def test_too_few_patches_tell_nothing_and_a_nan_is_refused() -> None:
    assert np.isnan(distinguished(np.zeros((3, 2)), np.zeros((100, 2))))
    with pytest.raises(DataError, match="finite features, 1 are not"):
        distinguished(np.full((20, 1), 0.0), np.r_[np.nan, np.zeros(19)][:, None])


@pytest.mark.parametrize("lasers", [0, 6, 16])
def test_scans_of_few_lasers_or_without_returns_have_no_patch(lasers: int) -> None:
    nothing = np.zeros((lasers, 128), np.float32)
    assert scan_features(nothing, nothing).shape == (0, 6)
