"""The job on a Ray cluster of this machine: a head and two workers, each with one core."""

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.conftest import clean_environment

pytestmark = [pytest.mark.slow, pytest.mark.cli]


def _free_port() -> int:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        return int(taken.getsockname()[1])


@pytest.fixture
def cluster() -> Iterator[str]:
    """Address of the job server of a cluster of three nodes; all are stopped after the test."""
    pytest.importorskip("dagster_ray", reason="the extra `ray` is not installed: pip install -e '.[ray]'")
    port, jobs = _free_port(), _free_port()
    ray = [
        str(Path(sys.executable).parent / "ray"),
        "start",
        "--block",
        "--num-cpus=1",
        "--disable-usage-stats",
    ]
    # A node's environment has nothing of this project: the executor must send it. Only the command `dagster`
    # of this interpreter's packages must be found.
    environment = clean_environment()
    environment["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{environment['PATH']}"
    started = [
        subprocess.Popen([*ray, *more], env=environment, start_new_session=True)
        for more in (
            ("--head", f"--port={port}", f"--dashboard-port={jobs}", "--include-dashboard=true"),
            (f"--address=127.0.0.1:{port}",),
            (f"--address=127.0.0.1:{port}",),
        )
    ]  # fmt: skip
    try:
        _wait_for_jobs(jobs)
        yield f"http://127.0.0.1:{jobs}"
    finally:
        for process in reversed(started):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGTERM)
        for process in started:
            process.wait(60)


def _wait_for_jobs(port: int) -> None:
    until_s = time.monotonic() + 120.0
    while time.monotonic() < until_s:
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1.0):
            time.sleep(5.0)  # the other nodes join
            return
        time.sleep(0.5)
    raise TimeoutError(f"no job server on port {port}")


def test_every_step_runs_on_ray_and_the_data_sets_are_there(
    cluster: str, run_process, tiny_catalogue: Path, tmp_path: Path, repo: Path
) -> None:
    dagster_home = tmp_path / "home" / "dagster"
    dagster_home.mkdir(parents=True)
    shutil.copy(repo / "pipelines" / "dagster.yaml", dagster_home)
    done = run_process(
        "dagster", "job", "execute", "-j", "train_all_scenes", timeout_s=900.0,
        DAGSTER_MODULE_NAME="pipelines.definitions", NVSF_EXECUTOR="ray", RAY_ADDRESS=cluster,
        NVSF_SCENES=str(tiny_catalogue), NVSF_HOME=str(tmp_path / "home"), DAGSTER_HOME=str(dagster_home),
        PYTHONPATH=str(repo),
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert list((tmp_path / "home/tiny/dataset/shift_1m").glob("*/manifest.json"))
    from ray.job_submission import JobSubmissionClient

    jobs = JobSubmissionClient(cluster).list_jobs()
    steps = {job.metadata.get("dagster/op", "").split("[")[0] for job in jobs}
    assert {"choose_scenes", "field_of_scene", "report_all"} <= steps
    nodes = {job.driver_node_id for job in jobs}
    assert len(nodes) >= 2, "not all steps ran on the head"
