"""A failure calls the user's command, with what failed; the command itself can fail nothing."""

import json
import sys
from pathlib import Path

import dagster as dg
import pytest

from pipelines.failures import COMMAND_VARIABLE, call_command, failure_command


@dg.op
def torn() -> None:
    raise dg.Failure("the scan is torn")


@dg.job(tags={"dagster/partition": "tiny"})
def failing() -> None:
    torn()


def test_a_failed_run_calls_the_command_with_its_scene_and_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = tmp_path / "found.json"
    monkeypatch.setenv(COMMAND_VARIABLE, f"{sys.executable} -c \"open('{found}', 'w').write(input())\"")
    with dg.DagsterInstance.ephemeral() as instance:
        result = failing.execute_in_process(instance=instance, raise_on_error=False)
        context = dg.build_run_status_sensor_context(
            sensor_name="failure_command", dagster_instance=instance, dagster_run=result.dagster_run,
            dagster_event=result.get_run_failure_event(),
        ).for_run_failure()  # fmt: skip
        failure_command(context)
    said = json.loads(found.read_text())
    assert (said["run_id"], said["job"], said["scene"]) == (result.run_id, "failing", "tiny")
    assert "torn: " in said["words"] and "the scan is torn" in said["words"]


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("", "names no command"),
        ("/nowhere/mail", "No such file"),
        ("false", "ended with 1"),
        ("'", "closing"),
    ],
)
def test_a_command_that_cannot_be_called_is_only_said(
    monkeypatch: pytest.MonkeyPatch, command: str, words: str
) -> None:
    monkeypatch.setenv(COMMAND_VARIABLE, command)
    assert words in call_command({"run_id": "1"})
