import math
from collections.abc import Mapping

import pytest

from nvsf_core.metrics.trust.cues import (
    BAND,
    GUESSED,
    IMAGE_CUES,
    MISSING,
    PROTOCOL,
    SCAN_CUES,
    SCAN_PATCHES,
    SCAN_SCORE,
    SCORE,
)
from nvsf_core.metrics.trust.verdict import Band, Trust, Verdict, score_of, verdicts

RECORDED = {cue.name: 0.1 for cue in SCAN_CUES if cue != MISSING}


def _rows(values: Mapping[str, float], bands: Mapping[str, float]) -> list[dict]:
    facts = {"protocol": PROTOCOL, "split": "shift_1m", "sensor": "lidar", "n_frames": 10, "n_defined": 10}
    rows = [{**facts, "region": "all", "metric": name, "value": value} for name, value in values.items()]
    rows += [
        {**facts, "region": region, "metric": name, "value": value * share}
        for region, share in zip(BAND, (0.9, 1.0, 1.2), strict=True)
        for name, value in bands.items()
    ]
    return [*rows, {**facts, "protocol": "raw", "region": "all", "metric": "f_score", "value": 0.1}]


def _verdict(changed: Mapping[str, float], guessed: float = 0.0, *, banded: bool = True) -> Verdict:
    cues = RECORDED | changed
    values = cues | {SCORE: score_of(cues, "lidar"), GUESSED: guessed}
    (found,) = verdicts(_rows(values, RECORDED | {SCORE: 0.1} if banded else {}))
    return found


def test_a_scan_scores_by_the_mean_and_an_image_by_the_mean_square_of_its_cues() -> None:
    cues = dict(zip((cue.name for cue in SCAN_SCORE), (0.1, 0.2, 0.6), strict=True))
    assert score_of(cues, "lidar") == pytest.approx(0.3)
    assert score_of(
        {"trust_images_disagree": 0.03, "trust_parallax_error": 0.04}, "image_00"
    ) == pytest.approx(math.sqrt(0.00125))
    assert math.isnan(score_of({}, "lidar"))


def test_a_view_like_the_recorded_is_as_recorded() -> None:
    found = _verdict({})
    assert (found.trust, found.ratio) == (Trust.AS_RECORDED, pytest.approx(1.0))
    assert "as well as these fit each other" in found.why


@pytest.mark.parametrize("cue", SCAN_CUES, ids=lambda cue: cue.name)
def test_a_verdict_only_gets_worse_as_a_cue_grows(cue) -> None:
    found = [_verdict({cue.name: value}) for value in (0.05, 0.1, 0.2, 0.5, 1.0, 2.0)]
    assert [one.trust for one in found] == sorted(one.trust for one in found)
    assert found[-1].trust > Trust.AS_RECORDED
    assert cue.reason[1:] in found[-1].why


def test_a_score_above_all_recorded_ones_is_not_as_recorded_however_near_the_median() -> None:
    cues = RECORDED | {SCAN_SCORE[0].name: 0.115}
    rows = _rows(cues | {SCORE: 0.105}, RECORDED | {SCORE: 0.1})
    high = next(row for row in rows if (row["region"], row["metric"]) == (BAND[2], SCORE))
    assert verdicts(rows)[0].trust is Trust.AS_RECORDED
    high["value"] = 0.104
    assert verdicts(rows)[0].trust is Trust.WITH_CARE


def test_a_view_of_which_some_scans_have_no_score_is_not_as_recorded_and_says_how_many() -> None:
    rows = _rows(RECORDED | {SCORE: 0.1}, RECORDED | {SCORE: 0.1})
    score = next(row for row in rows if (row["region"], row["metric"]) == ("all", SCORE))
    score["n_defined"] = 1
    (found,) = verdicts(rows)
    assert found.trust is Trust.WITH_CARE
    assert "9 of its 10 scans could not be compared" in found.why


def test_what_is_guessed_makes_it_worse_and_is_said_in_percent() -> None:
    said = [_verdict({}, guessed).trust for guessed in (0.005, 0.02, 0.3)]
    assert said == [Trust.AS_RECORDED, Trust.WITH_CARE, Trust.DO_NOT_USE]
    assert "30 % of its rays look at what nobody recorded" in _verdict({}, 0.3).why
    # As "1 %" it would be no more than the limit.
    assert "1.4 % of its rays look at what nobody recorded" in _verdict({}, 0.014).why


def test_missing_returns_make_it_worse_whatever_the_score_and_are_said_in_percent() -> None:
    said = [_verdict({MISSING.name: share}).trust for share in (math.nan, 0.044, 0.067, 0.97)]
    assert said == [Trust.AS_RECORDED, Trust.AS_RECORDED, Trust.WITH_CARE, Trust.DO_NOT_USE]
    assert "no returns where the recorded scans near by" in _verdict({MISSING.name: 0.97}).why
    assert "97 % of these are missing" in _verdict({MISSING.name: 0.97}).why


def test_patches_that_are_easily_distinguished_ask_for_care_of_scans_and_of_images() -> None:
    among_recorded = {SCAN_PATCHES.name: 0.51}
    for sensor, cues in (("lidar", SCAN_CUES), ("image_00", IMAGE_CUES)):
        said = []
        for area in (0.82, 0.95):
            values = {cue.name: 0.1 for cue in cues} | {
                SCORE: 0.1,
                SCAN_PATCHES.name: area,
                MISSING.name: 0.0,
            }
            rows = _rows(values, {cue.name: 0.1 for cue in cues} | {SCORE: 0.1} | among_recorded)
            said += verdicts([{**row, "sensor": sensor} for row in rows])
        assert [one.trust for one in said] == [Trust.AS_RECORDED, Trust.WITH_CARE]
        assert "a small classifier easily distinguishes its patches" in said[1].why.lower()


@pytest.mark.parametrize(("view", "score", "n_frames", "is_single"), [
    ("test", math.nan, 1, True), ("shift_1m", 0.1, 8, True),
    ("test", math.nan, 4, False), ("shift_1m", math.nan, 1, False),
])  # fmt: skip
def test_a_single_held_out_image_makes_no_band_and_is_said(view, score, n_frames, is_single) -> None:
    facts = {"sensor": "image_00", "split": view, "n_frames": n_frames, "n_defined": 0}
    (found,) = verdicts([{**row, **facts} for row in _rows({SCORE: score}, {})])
    assert found.trust is Trust.NOT_KNOWN
    assert ("a single image was held out" in found.why) == is_single
    assert ("no recorded ones were left over" in found.why) != is_single


def test_without_recorded_data_to_compare_with_nothing_is_known() -> None:
    found = _verdict({}, banded=False)
    assert found.trust is Trust.NOT_KNOWN and "left over" in found.why
    assert Band.of([math.nan]) is None
    assert Band.of([3.0, 1.0, math.nan, 2.0, 8.0]) == Band(1.0, 2.5, 8.0)
