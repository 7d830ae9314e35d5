import math

import numpy as np
import pytest

from nvsf_core.errors import ShapeError
from nvsf_core.metrics.elementwise import PSNR_CAP_DB, median_abs_error, psnr, rmse


def test_errors_of_known_pairs() -> None:
    truth = np.array([0.0, 0.0, 0.0, 0.0])
    predicted = np.array([1.0, -1.0, 3.0, -3.0])
    assert rmse(predicted, truth).value == pytest.approx(math.sqrt(5.0))
    assert median_abs_error(predicted, truth).value == pytest.approx(2.0)
    assert psnr(predicted, truth, peak=10.0).value == pytest.approx(10 * math.log10(100 / 5.0))
    assert psnr(predicted, truth, peak=10.0).n_valid == 4


def test_a_perfect_answer_has_the_stated_psnr() -> None:
    image = np.linspace(0, 80, 50)
    assert psnr(image, image, peak=80.0).value == PSNR_CAP_DB


def test_undefined_is_nan_with_a_reason_and_never_zero() -> None:
    for measure in (
        rmse(np.zeros(0), np.zeros(0)),
        psnr(np.array([np.nan, 1.0]), np.ones(2), peak=1.0),
        median_abs_error(np.ones(2), np.array([np.inf, 1.0])),
    ):
        assert math.isnan(measure.value)
        assert measure.reason
    assert "1 of 2 predicted" in rmse(np.array([np.nan, 1.0]), np.ones(2)).reason


def test_shapes_that_would_broadcast_are_refused() -> None:
    with pytest.raises(ShapeError, match="render it again"):
        rmse(np.zeros((3, 1)), np.zeros((3, 4)))
