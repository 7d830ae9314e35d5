"""A switch of the environment says yes or no in the usual words, and nothing else does either."""

import os

import pytest

from nvsf_core.errors import RecipeError
from pipelines.doctor.findings import examine
from pipelines.switch import AUTOMATE_VARIABLE, is_on


@pytest.mark.parametrize(
    ("words", "expected"),
    [(("1", "true", "True", "YES", "on"), True), (("", "0", "false", "False", "No", "OFF"), False)],
)
def test_a_switch_takes_the_usual_words_in_any_case(words, expected):
    assert [is_on("NVSF_X", {"NVSF_X": word}) for word in words] == [expected] * len(words)
    assert not is_on("NVSF_X", {})


@pytest.mark.parametrize("word", ["disabled", "2", "n", "of"])
def test_another_word_is_refused_by_name_and_the_doctor_says_so(word, monkeypatch):
    with pytest.raises(RecipeError, match=f"NVSF_AUTOMATE='{word}': expected 1, true, yes, on, or 0"):
        is_on(AUTOMATE_VARIABLE, {AUTOMATE_VARIABLE: word})
    monkeypatch.setenv(AUTOMATE_VARIABLE, word)
    (found,) = [one for one in examine(os.environ) if one.subject == "automation"]
    assert not found.is_fine and found.is_needed and word in found.words


def test_automation_is_off_where_the_variable_says_false(run_process, tmp_path):
    said = "from pipelines.sensors import scenes_follow as s; print(s.default_status.value)"
    done = run_process("python", "-c", said, NVSF_AUTOMATE="false", PYTHONPATH=".")
    assert done.stdout.strip() == "STOPPED", done.stderr
