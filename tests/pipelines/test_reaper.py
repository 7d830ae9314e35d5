"""A killed run is marked as failed; a living one, and one of another machine, never."""

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import dagster as dg
import pytest

from pipelines import reaper
from pipelines.definitions import defs
from pipelines.reaper import HOST_TAG, host_tags, reap, stale_run_reaper

RUN = """
import time
import dagster as dg
from pipelines.reaper import host_tags

@dg.op
def wait():
    print("waiting", flush=True)
    time.sleep(300)

@dg.job
def waiting():
    wait()

waiting.execute_in_process(instance=dg.DagsterInstance.get(), tags=host_tags())
"""


@pytest.fixture
def instance(tmp_path, monkeypatch):
    (tmp_path / "dagster.yaml").write_text("telemetry:\n  enabled: false\n")
    monkeypatch.setenv("DAGSTER_HOME", str(tmp_path))
    with dg.DagsterInstance.get() as instance:
        yield instance


@pytest.fixture
def start_run(instance, repo):
    """Start a run in a process of its own; returns the process, once the run is in its step."""
    processes = []

    def start():
        process = subprocess.Popen(
            [sys.executable, "-c", RUN], cwd=repo, env=dict(os.environ), text=True,
            stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        processes.append(process)
        assert process.stdout.readline() == "waiting\n"
        return process, instance.get_run_records(limit=1)[0].dagster_run.run_id

    yield start
    for process in processes:
        process.kill()
        process.communicate()


def _status(instance, run_id):
    return instance.get_run_by_id(run_id).status


def test_only_a_run_whose_process_is_gone_is_marked(instance, start_run, monkeypatch):
    killed, killed_id = start_run()
    _, living_id = start_run()
    killed.send_signal(signal.SIGKILL)
    _wait_for_zombie(killed)
    here = instance.get_run_by_id(killed_id).tags[HOST_TAG]
    instance.add_run_tags(killed_id, {HOST_TAG: "other_machine/12345678"})
    assert reap(instance, quiet_s=0.0) == [], "another machine's processes cannot be seen"
    instance.add_run_tags(killed_id, {HOST_TAG: here})
    assert reap(instance, quiet_s=3600.0) == [], "what spoke just now is left alone"
    # As if the clock was set forward by an hour since: all processes seem to have begun after they spoke.
    now_s = reaper._machine_started_s()
    monkeypatch.setattr(reaper, "_machine_started_s", lambda: now_s + 3600.0)
    assert reap(instance, quiet_s=0.0) == [killed_id]
    assert _status(instance, killed_id) == dg.DagsterRunStatus.FAILURE
    assert _status(instance, living_id) == dg.DagsterRunStatus.STARTED
    instance.add_run_tags(living_id, {HOST_TAG: f"{socket.gethostname()}/00000000"})
    assert reap(instance, quiet_s=0.0) == [living_id], "no process outlives its machine's boot"


def _wait_for_zombie(process):
    """Killed but not yet waited for: its number is still listed under /proc."""
    while Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z":
        time.sleep(0.01)


def test_the_sensor_says_what_it_did(instance):
    reason = stale_run_reaper(dg.build_sensor_context(instance=instance))
    assert reason.skip_message == "no stale run"


def test_our_jobs_runs_name_their_machine_unless_steps_go_elsewhere(monkeypatch):
    for name in ("train_all_scenes", "benchmark", "train_scene", "regenerate_synthetic"):
        assert defs.resolve_job_def(name).tags[HOST_TAG].startswith(f"{socket.gethostname()}/")
    monkeypatch.setenv("NVSF_EXECUTOR", "ray")
    assert host_tags() == {}
