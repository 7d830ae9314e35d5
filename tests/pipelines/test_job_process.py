"""Ctrl-C and SIGTERM end a run of `nvsf`, which says how to go on, and leave no run that is said to run."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import dagster as dg
import pytest

from pipelines.instance import TEMPLATE
from pipelines.job_process import INTERRUPTED
from tests.conftest import clean_environment


def _as_in_a_terminal() -> None:
    """Heed what `nohup`, a shell's background or a supervisor ignores, and so do its children."""
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGQUIT, signal.SIGTERM, signal.SIGTSTP):
        signal.signal(number, signal.SIG_DFL)


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
        preexec_fn=_as_in_a_terminal,
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


_WAITING = """
import os, sys
from pipelines.job_process import _status_of
one = "import os, time; print(os.getpid(), flush=True); time.sleep(200)"
sys.exit(_status_of([sys.executable, "-c", one], os.environ))
"""


def _wait_for(state: str, *processes: int) -> None:
    """Until all are in this state of /proc's: S sleeping, T stopped."""
    until_s = time.monotonic() + 60.0
    stats = [Path(f"/proc/{one}/stat") for one in processes]
    while any(stat.read_text().rpartition(")")[2].split()[0] != state for stat in stats):
        assert time.monotonic() < until_s, [stat.read_text() for stat in stats]
        time.sleep(0.02)


def test_ctrl_z_stops_what_runs_too_and_it_ends_where_the_terminal_is_closed(repo: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", _WAITING], cwd=repo, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        start_new_session=True, preexec_fn=_as_in_a_terminal,
    ) as process:  # fmt: skip
        assert process.stdout is not None and process.stderr is not None
        both = (process.pid, int(process.stdout.readline()))
        os.killpg(process.pid, signal.SIGTSTP)
        _wait_for("T", *both)
        os.killpg(process.pid, signal.SIGCONT)
        _wait_for("S", *both)
        os.killpg(process.pid, signal.SIGHUP)
        said = process.stderr.read()
    assert process.returncode == 128 + signal.SIGHUP and said == f"{INTERRUPTED}\n"
    assert not Path(f"/proc/{both[1]}").exists()
