"""Candidates are compared on the same left-out data; what is undefined never wins."""

import math

import pytest

from nvsf_core.models.holdout import compare, is_sure, validation_numbers

METRICS = {"error_m": False, "psnr_db": True, "f_score": True}


def _compared(ours, theirs):
    return compare(METRICS, [0, 1], {"ours": lambda one: ours[one], "theirs": lambda one: theirs[one]})


def test_scores_are_means_over_the_left_out_data():
    found = _compared([(1.0, 20.0, 0.5), (3.0, 30.0, 0.7)], [(2.0, 10.0, 0.1)] * 2)
    assert found.of("ours", "error_m") == 2.0 and found.of("ours", "psnr_db") == 25.0
    assert found.of("theirs", "f_score") == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("ours", "wins"),
    [
        ((0.5, 30.0, 0.9), True),
        ((1.1, 19.5, 0.8), True),
        ((0.9, 20.5, 0.1), False),
        ((1.0, 20.0, 0.5), False),
        ((2.0, 20.0, 0.76), True),
        ((2.0, 20.0, 0.74), False),
        ((2.0, 26.1, 0.5), True),
        ((2.0, 25.9, 0.5), False),
        ((1.0, math.nan, 0.6), True),
        ((math.nan, math.nan, 0.9), False),
        ((math.nan, math.nan, math.nan), False),
    ],
)
def test_errors_are_compared_by_their_ratios_and_a_tie_is_no_win(ours, wins):
    assert _compared([ours] * 2, [(1.0, 20.0, 0.5)] * 2).wins("ours", "theirs") is wins


def test_what_is_undefined_is_not_better_and_is_said_in_words():
    found = _compared([(math.nan, 30.0, 0.9)] * 2, [(1.0, 20.0, 0.5)] * 2)
    assert not found.is_better("ours", "error_m", "theirs") and found.wins("ours", "theirs")
    figures = found.figures({"ours": "", "theirs": "reproject_"})
    assert figures["error_m"] == "undefined" and figures["reproject_error_m"] == 1.0


@pytest.mark.parametrize("count", range(2, 30))
def test_some_are_kept_out_and_never_all(count):
    numbers = list(validation_numbers(count, 9, 3))
    assert 1 <= len(numbers) < count and numbers[0] == min(3, count // 2)


@pytest.mark.parametrize(
    ("gains", "sure"), [([1.0, 1.1, 0.9], True), ([1.0, -1.0, 0.5], False), ([-1.0] * 3, False)]
)
def test_a_gain_is_sure_beyond_two_standard_errors(gains, sure):
    assert is_sure(gains) is sure
