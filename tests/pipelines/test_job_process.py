"""Ctrl-C ends a run of `nvsf`, which says how to go on, and leaves no run that is said to run."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import dagster as dg
import pytest

from pipelines.one_process import INTERRUPTED
from tests.conftest import clean_environment


def _heeds_ctrl_c() -> None:
    """As in a terminal: what a shell starts in the background ignores it, and so do its children."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.mark.cli
@pytest.mark.parametrize("executor", ["in_process", "multiprocess"])
def test_an_interrupted_run_ends_with_130_and_as_failed_in_dagsters_history(
    repo: Path, tiny_catalogue: Path, tmp_path: Path, executor: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    environment = clean_environment() | {
        "PYTHONPATH": str(repo), "NVSF_SCENES": str(tiny_catalogue), "NVSF_HOME": str(tmp_path),
        "NVSF_EXECUTOR": executor, "DAGSTER_DISABLE_TELEMETRY": "1", "NVSF_THREADS": "1",
    }  # fmt: skip
    with subprocess.Popen(
        [Path(sys.executable).with_name("nvsf"), "train", "tiny"], env=environment, text=True,
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True,
        preexec_fn=_heeds_ctrl_c,
    ) as process:  # fmt: skip
        assert process.stderr is not None
        # Nothing of the drive is made yet: what says `done` from here on was done in spite of Ctrl-C.
        next(line for line in process.stderr if "frames: " in line)
        os.killpg(process.pid, signal.SIGINT)
        said = process.stderr.read()
    assert process.returncode == 130 and said.count(INTERRUPTED) == 1, said
    assert "evidence: " not in said
    monkeypatch.setenv("DAGSTER_HOME", str(tmp_path / "dagster"))
    with dg.DagsterInstance.get() as instance:
        assert [run.status for run in instance.get_runs()] == [dg.DagsterRunStatus.FAILURE]
