"""A failure calls the user's command, with what failed; the command itself can fail nothing."""

import json
import sys
import time
from pathlib import Path

import dagster as dg
import pytest
from dagster._core.definitions.run_status_sensor_definition import _get_run_status_sensor_process_limit
from dagster._grpc.utils import default_sensor_grpc_timeout

from pipelines import failures
from pipelines.failures import COMMAND_VARIABLE, LONGEST_S, call_command, failure_command


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


def test_a_command_that_hangs_is_ended_with_all_that_it_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = tmp_path / "hangs.sh"
    script.write_text(f"sleep 300 &\necho $! > {tmp_path / 'child'}\nwait\n")
    monkeypatch.setenv(COMMAND_VARIABLE, f"sh {script}")
    monkeypatch.setattr(failures, "LONGEST_S", 1.0)
    assert "timed out after 1.0 seconds" in call_command({"run_id": "1"})
    child = Path("/proc") / (tmp_path / "child").read_text().strip()
    until_s = time.monotonic() + 10.0
    while (child / "stat").is_file() and (child / "stat").read_text().split()[2] != "Z":
        assert time.monotonic() < until_s, "what the command started goes on"
        time.sleep(0.05)


def test_what_a_command_leaves_at_work_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(COMMAND_VARIABLE, "sh -c 'sleep 20 & echo sent'")
    started_s = time.monotonic()
    assert call_command({"run_id": "1"}) == f"{COMMAND_VARIABLE}: ended with 0: sent"
    assert time.monotonic() - started_s < 10.0


def test_commands_that_hang_leave_a_tick_the_time_to_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DAGSTER_GRPC_TIMEOUT_SECONDS", raising=False)
    assert _get_run_status_sensor_process_limit() * LONGEST_S <= default_sensor_grpc_timeout() - 10.0
