"""`failure_command`: a sensor that calls a command of the user's when a run has failed."""

import json
import os
import shlex
import signal
import subprocess
import tempfile
from typing import Any

import dagster as dg

from assets.scenes import PARTITION_TAG

COMMAND_VARIABLE = "NVSF_ON_FAILURE"
CALLED_TAG = "nvsf/failure_command"
"""Tag of a run that has called the command itself, as a terminal's run does: a daemon need not be there."""
LONGEST_S = 10.0
"""Of one call: a tick calls for up to five failures. Dagster ends it after 60 s, and calls for them again."""
_MOST_WORDS = 4000


def named_command() -> str:
    """The user's command; empty if none is named."""
    return os.environ.get(COMMAND_VARIABLE, "").strip()


def call_command(failure: dict[str, Any]) -> str:
    """Call the user's command with a failure as JSON on its standard input; returns what came of it.

    A command that is absent, fails or hangs fails nothing else: only the returned words say so. One that
    hangs is ended with all that it started; what one that has ended left at work is not waited for.

    Args:
        failure: `run_id`, `job`, `scene` (empty for a run over several), `words`.
    """
    command = named_command()
    if not command:
        return f"{COMMAND_VARIABLE} names no command"
    try:
        code, words = _called(shlex.split(command), json.dumps(failure))
    except (OSError, ValueError, subprocess.TimeoutExpired) as error:
        return f"{COMMAND_VARIABLE}: {error}"
    return f"{COMMAND_VARIABLE}: ended with {code}" + (f": {words}" if words else "")


def _called(command: list[str], words: str) -> tuple[int, str]:
    """Exit status of a command, and what it said. Files, because a pipe ends with the last that holds it."""
    with tempfile.TemporaryFile("w+") as given, tempfile.TemporaryFile("w+", errors="replace") as said:
        given.write(words)
        given.seek(0)
        process = subprocess.Popen(
            command, stdin=given, stdout=said, stderr=subprocess.STDOUT, start_new_session=True
        )
        try:
            code = process.wait(LONGEST_S)
        except BaseException:  # also where the run is interrupted, as `subprocess.run` does
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            raise
        said.seek(0)
        return code, said.read(_MOST_WORDS).strip()


@dg.run_failure_sensor(
    default_status=dg.DefaultSensorStatus.RUNNING,
    description="Calls the command that NVSF_ON_FAILURE names, the failure as JSON on its standard input.",
)
def failure_command(context: dg.RunFailureSensorContext) -> dg.SkipReason:
    """Call the command for a failed run, unless it has called it itself."""
    run, event = context.dagster_run, context.failure_event
    if CALLED_TAG in run.tags:
        return dg.SkipReason(f"run {run.run_id} has called it itself")
    words = [event.message or "", *_step_errors(context)]
    failure = {
        "run_id": run.run_id,
        "job": run.job_name,
        "scene": run.tags.get(PARTITION_TAG, ""),
        "words": "\n".join(one for one in words if one)[:_MOST_WORDS],
    }
    return dg.SkipReason(call_command(failure))


def _step_errors(context: dg.RunFailureSensorContext) -> list[str]:
    """`<step>: <message>` of each failed step."""
    found = []
    for event in context.get_step_failure_events():
        error = event.step_failure_data.error
        found.append(f"{event.step_key}: {'' if error is None else error.message.strip()}")
    return found
