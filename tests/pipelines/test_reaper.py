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
from pipelines.reaper import (
    CLOCK_TAG,
    HOST_TAG,
    host_tags,
    reap,
    say_which_host_runs_it,
    stale_run_reaper,
)

ASSET = """
import time
import dagster as dg
from pipelines.executors import executor_from_environment

@dg.asset
def waits():
    print("waiting", flush=True)
    time.sleep(300)

defs = dg.Definitions(assets=[waits], executor=executor_from_environment())
"""
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


@pytest.mark.parametrize("executor", ["in_process", "multiprocess"])
def test_a_killed_run_of_assets_is_marked_though_it_is_of_no_job_of_ours(
    instance, repo, tmp_path, monkeypatch, executor
):
    monkeypatch.setenv("NVSF_EXECUTOR", executor)
    monkeypatch.delenv("DAGSTER_MODULE_NAME", raising=False)
    (tmp_path / "one_asset.py").write_text(ASSET)
    command = [sys.executable, "-m", "dagster", "asset", "materialize", "--select", "waits"]
    process = subprocess.Popen(
        [*command, "-f", str(tmp_path / "one_asset.py")], cwd=repo, env=dict(os.environ), text=True,
        stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, start_new_session=True,
    )  # fmt: skip
    assert process.stdout.readline() == "waiting\n"
    run_id = instance.get_run_records(limit=1)[0].dagster_run.run_id
    assert reap(instance, quiet_s=0.0) == []
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    # A killed step process, which nobody here waits for, closes its files a moment before it is gone.
    deadline_s = time.monotonic() + 10.0
    while not (reaped := reap(instance, quiet_s=0.0)) and time.monotonic() < deadline_s:
        time.sleep(0.05)
    assert reaped == [run_id]
    assert _status(instance, run_id) == dg.DagsterRunStatus.FAILURE


def test_a_run_whose_process_was_killed_before_it_began_is_marked_once_it_is_late(tmp_path):
    monitoring = "run_monitoring:\n  enabled: true\n  start_timeout_seconds: 2\n"
    (tmp_path / "dagster.yaml").write_text(f"telemetry:\n  enabled: false\n{monitoring}")
    with dg.DagsterInstance.from_config(str(tmp_path)) as instance:
        late = instance.create_run_for_job(_empty)
        assert reap(instance, quiet_s=0.0) == [], "its process is about to begin"
        time.sleep(2.5)
        young = instance.create_run_for_job(_empty)
        assert reap(instance, quiet_s=0.0) == [late.run_id]
        assert _status(instance, late.run_id) == dg.DagsterRunStatus.FAILURE
        assert _status(instance, young.run_id) == dg.DagsterRunStatus.NOT_STARTED


@dg.job
def _empty(): ...


def test_a_run_that_goes_on_after_the_machine_was_started_again_is_of_its_new_boot(instance):
    old = {HOST_TAG: f"{socket.gethostname()}/00000000", CLOCK_TAG: "1"}
    run = instance.create_run_for_job(_empty, tags=old)
    say_which_host_runs_it(instance, run.run_id)
    assert {name: instance.get_run_by_id(run.run_id).tags[name] for name in host_tags()} == host_tags()


def test_a_run_names_no_machine_where_its_steps_go_elsewhere(monkeypatch):
    assert host_tags()[HOST_TAG].startswith(f"{socket.gethostname()}/")
    monkeypatch.setenv("NVSF_EXECUTOR", "ray")
    assert host_tags() == {}
