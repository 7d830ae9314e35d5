"""Ctrl-C and SIGTERM end a run of `nvsf`, which says how to go on, and leave no run that is said to run."""

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import dagster as dg
import pytest

from pipelines.instance import TEMPLATE
from pipelines.job_process import INTERRUPTED
from tests.conftest import clean_environment


def _heeds_ctrl_c() -> None:
    """As in a terminal: what a shell starts in the background ignores it, and so do its children."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.mark.cli
@pytest.mark.parametrize(
    ("executor", "number"),
    [("in_process", signal.SIGINT), ("multiprocess", signal.SIGINT), ("multiprocess", signal.SIGTERM)],
)
def test_a_run_that_is_told_to_end_says_one_line_and_is_failed_in_dagsters_history(
    repo: Path, tiny_catalogue: Path, tmp_path: Path, executor: str, number: signal.Signals,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    (tmp_path / "dagster").mkdir()
    shutil.copy(repo / "pipelines" / TEMPLATE, tmp_path / "dagster")
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
        # Nothing of the drive is made yet: what says `done` from here on was done in spite of the signal.
        next(line for line in process.stderr if "frames: " in line)
        if number == signal.SIGINT:
            os.killpg(process.pid, number)  # as a terminal does
        else:
            process.send_signal(number)
        said = process.stderr.read()  # until the last process that may write is gone
    assert process.returncode == 128 + number and said.count(INTERRUPTED) == 1, said
    assert "evidence: " not in said, said
    *_, ours, dagsters = said.splitlines()
    assert ours.endswith(INTERRUPTED) and dagsters.startswith("Error: Run "), said
    assert "Traceback" not in said and "DagsterExecutionInterruptedError" not in said, said
    monkeypatch.setenv("DAGSTER_HOME", str(tmp_path / "dagster"))
    with dg.DagsterInstance.get() as instance:
        assert [run.status for run in instance.get_runs()] == [dg.DagsterRunStatus.FAILURE]
