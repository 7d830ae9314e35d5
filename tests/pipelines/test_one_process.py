"""Ctrl-C ends a run in one process; it is no step that was killed, which is tried again."""

import os
import signal

import dagster as dg

from pipelines.job_process import INTERRUPTED
from pipelines.one_process import one_process


@dg.op(retry_policy=dg.RetryPolicy(max_retries=2), tags={"dagster/priority": "1"})
def interrupted() -> int:
    os.kill(os.getpid(), signal.SIGINT)
    return 42


@dg.op
def another() -> int:
    return 42


@dg.job(executor_def=one_process)
def stopping() -> None:
    interrupted()
    another()


def test_an_interrupted_step_is_not_tried_again_and_ends_the_run_in_words(tmp_path, monkeypatch):
    (tmp_path / "dagster.yaml").write_text("telemetry:\n  enabled: false\n")
    monkeypatch.setenv("DAGSTER_HOME", str(tmp_path))
    with dg.DagsterInstance.get() as instance:
        done = dg.execute_job(dg.reconstructable(stopping), instance, raise_on_error=False)
        status = instance.get_run_by_id(done.run_id).status
        said = [entry.user_message for entry in instance.all_logs(done.run_id)]
    started = [event.step_key for event in done.all_events if event.is_step_start]
    assert (started, status) == (["interrupted"], dg.DagsterRunStatus.FAILURE)
    assert INTERRUPTED in said
