"""The daemon of a real instance: a drive that is dropped into a folder becomes data sets, no hand on it."""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import dagster as dg
import pytest

from assets.scenes import SCENES, key_of
from nvsf_core.stages import STAGE_NAMES
from tests.conftest import TINY_CATALOGUE, clean_environment

pytestmark = [pytest.mark.slow, pytest.mark.cli]
_LONGEST_S = 1800.0


@pytest.fixture
def folder(tmp_path: Path, repo: Path) -> Path:
    """A catalogue whose drive is not there yet, a home, and an instance that nothing ran on."""
    (tmp_path / "scenes.toml").write_text(TINY_CATALOGUE)
    (tmp_path / "home/dagster").mkdir(parents=True)
    shutil.copy(repo / "pipelines/dagster.yaml", tmp_path / "home/dagster")
    return tmp_path


@pytest.fixture
def daemon(folder: Path, repo: Path) -> Iterator[subprocess.Popen[bytes]]:
    """`dagster-daemon run`, as `make ui` and compose start it."""
    variables = {
        "NVSF_SCENES": str(folder / "scenes.toml"), "NVSF_HOME": str(folder / "home"), "NVSF_QUIET_S": "5",
        "DAGSTER_HOME": str(folder / "home/dagster"), "NVSF_AUTOMATE": "1", "PYTHONPATH": str(repo),
        "DAGSTER_DISABLE_TELEMETRY": "1", "DAGSTER_GRPC_TIMEOUT_SECONDS": "600", "NVSF_THREADS": "1",
    }  # fmt: skip
    command = [sys.executable, "-m", "dagster._daemon", "run", "-m", "pipelines.definitions"]
    with (folder / "daemon.txt").open("wb") as said:
        process = subprocess.Popen(
            command, cwd=repo, env=clean_environment() | variables, stdout=said, stderr=said,
            start_new_session=True,
        )  # fmt: skip
    yield process
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGTERM)
    process.wait(60)


def _wait(what: str, is_so: Callable[[], bool], daemon: subprocess.Popen[bytes], folder: Path) -> None:
    started_s = time.monotonic()
    while not is_so():
        is_late = time.monotonic() - started_s > _LONGEST_S
        assert daemon.poll() is None and not is_late, f"{what}: {(folder / 'daemon.txt').read_text()[-2000:]}"
        time.sleep(2.0)


def test_a_drive_dropped_into_a_folder_becomes_data_sets(
    daemon: subprocess.Popen[bytes], folder: Path, tiny_catalogue: Path
) -> None:
    def all_made() -> bool:
        runs = instance.get_runs()
        return bool(runs) and all(run.is_finished for run in runs) and report.is_file()

    def scenes_runs() -> list[dg.DagsterRun]:
        return instance.get_runs(dg.RunsFilter(tags={"dagster/partition": "tiny"}))

    report = folder / "home/benchmark_report/index.html"
    with dg.DagsterInstance.from_config(str(folder / "home/dagster")) as instance:
        _wait("a daemon", lambda: bool(instance.get_daemon_heartbeats()), daemon, folder)
        shutil.copytree(tiny_catalogue.parent / "drive", folder / "drive")
        _wait("data sets and report", all_made, daemon, folder)
        (run,) = scenes_runs()
        assert run.status is dg.DagsterRunStatus.SUCCESS
        assert run.tags["dagster/sensor_name"] == "scenes_follow"
        for view in ("test", "shift_1m"):
            assert len(list((folder / "home/tiny/dataset" / view).glob("*/manifest.json"))) == 1
        assert instance.get_dynamic_partitions(SCENES.name or "") == ["tiny"]

        (poses,) = (folder / "drive").rglob("poses.txt")
        poses.write_text(poses.read_text() + "\n")
        _wait("a second run", lambda: len(scenes_runs()) == 2, daemon, folder)
        _wait("its end", all_made, daemon, folder)
        again, _ = scenes_runs()
        newest = [instance.get_latest_materialization_event(key_of(name)) for name in STAGE_NAMES]
        assert [one.run_id for one in newest if one is not None] == [again.run_id] * len(STAGE_NAMES)
        made = [one.asset_materialization for one in newest if one is not None]
        anew = [one.asset_key.path[-1] for one in made if one and not one.metadata["was_up_to_date"].value]
        assert again.status is dg.DagsterRunStatus.SUCCESS
        assert anew == ["frames", "sweeps"], "they read the drive"
