"""A run goes on where the process that starts its steps is killed while it starts one, or says what died."""

import multiprocessing.forkserver
import os
import signal
import threading
import time

import dagster as dg
import pytest

from pipelines.step_processes import _preloaded, step_processes


@dg.op
def answer() -> int:
    return 42


@dg.job(executor_def=step_processes(1))
def answering() -> None:
    answer()


def _kill_servers(count: int, is_over: threading.Event) -> None:
    """Kill one server after the other while it still imports: the run waits for its first step meanwhile."""
    server = multiprocessing.forkserver._forkserver
    killed: set[int] = set()
    while len(killed) < count and not is_over.is_set():
        number = server._forkserver_pid
        if number is not None and number not in killed:
            time.sleep(0.2)
            os.kill(number, signal.SIGKILL)
            killed.add(number)
        time.sleep(0.01)


@pytest.fixture
def run_under_fire(tmp_path, monkeypatch):
    """Run the job while so many servers are killed; returns the result, and all messages of its run."""
    (tmp_path / "dagster.yaml").write_text("telemetry:\n  enabled: false\n")
    monkeypatch.setenv("DAGSTER_HOME", str(tmp_path))
    # All that this job needs: a server imports less before it can start a step.
    monkeypatch.setattr("pipelines.step_processes._PRELOADED", "dagster")

    def run(count: int):
        multiprocessing.forkserver._forkserver._stop()
        is_over = threading.Event()
        killer = threading.Thread(target=_kill_servers, args=(count, is_over))
        killer.start()
        try:
            with dg.DagsterInstance.get() as instance:
                done = dg.execute_job(dg.reconstructable(answering), instance, raise_on_error=False)
                said = [entry.user_message for entry in instance.all_logs(done.run_id)]
                said += [str(event.event_specific_data) for event in done.all_events if event.is_run_failure]
        finally:
            is_over.set()
            killer.join()
        return done, "\n".join(said)

    yield run
    multiprocessing.forkserver._forkserver._stop()


def test_a_run_whose_server_of_steps_is_killed_goes_on_and_says_so(run_under_fire):
    done, said = run_under_fire(1)
    assert done.success, said
    assert "was killed (by hand, or out of memory) while it started the step answer; another one" in said


def test_a_run_whose_servers_are_killed_again_and_again_ends_in_plain_words(run_under_fire):
    done, said = run_under_fire(9)
    assert not done.success
    assert "while it started the step answer; so were the 3 in its place. Run again" in said


def test_the_server_imports_what_the_instance_needs_before_a_step_has_to(tmp_path):
    with dg.DagsterInstance.local_temp(str(tmp_path)) as instance:
        opened = [instance.event_log_storage, instance.run_storage, instance.compute_log_manager]
        assert {type(one).__module__ for one in opened} <= set(_preloaded())
