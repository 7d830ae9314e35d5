"""The report says of each check its value, its limit and a verdict in words; doubts stand first."""

from datetime import UTC, datetime

import pytest

from nvsf_core.reporting.checks import checks_section
from nvsf_core.reporting.scene_outputs import FieldRun, SceneOutputs
from nvsf_core.reporting.stage_record import StageRecord


def _check(name, passed, detail, value=None, limit=None, unit=""):
    return {"name": name, "passed": passed, "detail": detail, "value": value, "limit": limit, "unit": unit}


def _record(stage, *checks):
    return StageRecord(
        stage=stage, seconds=1.0, metadata={}, checks=list(checks), facts={}, made_s=0.0, content=""
    )


def _scene(*records):
    run = FieldRun(
        recipe="quick", seed=0, commit="", machine="", measured=datetime.now(UTC), means=[], curve={},
        pictures=[],
    )  # fmt: skip
    return SceneOutputs(name="street", records=list(records), runs=[run])


HOLDS = _check("poses_agree", True, "2 pairs", 0.012, 0.15, "m")
DOUBT = _check("hit_rate_is_as_recorded", False, "worst <frame 7>", 0.2, 0.03)


def test_value_limit_and_verdict_stand_in_words_and_doubts_first():
    text = checks_section(_scene(_record("sweeps", HOLDS), _record("scene_metrics quick 0", DOUBT)))
    assert "<b>1 of 2 checks raise a doubt</b>" in text
    assert "<td>0.012 m</td><td>0.150 m</td>" in text and "holds <" in text
    assert '<b class="doubt">doubt:</b> worst &lt;frame 7&gt;' in text
    assert text.index("hit rate is as recorded") < text.index("poses agree")


def test_what_could_not_be_run_says_why_and_is_no_doubt():
    text = checks_section(_scene(_record("sweeps", _check("poses_agree", True, "not run: one scan"))))
    assert "not run: one scan" in text and "Every check holds, 1 of 1" in text


def test_where_every_check_holds_words_stand_in_place_of_a_table():
    text = checks_section(_scene(_record("sweeps", HOLDS)))
    assert "Every check holds, 1 of 1" in text
    assert "<table" not in text[: text.index("<details>")]


def test_older_runs_are_folded_away():
    text = checks_section(_scene(_record("field quick 0", HOLDS), _record("field lean 1", DOUBT)))
    assert "Every check holds, 1 of 1" in text
    assert text.index("<details>") < text.index("field lean 1")


def test_a_doubt_without_a_number_is_shown_too():
    copied = _check("every_scan_is_another", False, "1 group of frames with the same file: frames 7, 8")
    text = checks_section(_scene(_record("frames", copied, _check("poses_are_there", True, "9 of 9"))))
    assert "<b>1 of 1 checks raise a doubt</b>" in text and "frames 7, 8" in text
    assert "poses are there" not in text, "what holds and has no number says nothing"


@pytest.mark.parametrize("records", [(), (_record("frames", _check("poses_are_there", True, "3 of 3")),)])
def test_a_scene_of_which_nothing_was_judged_by_a_number_has_no_section(records):
    assert checks_section(_scene(*records)) == ""
