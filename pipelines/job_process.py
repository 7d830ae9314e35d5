"""Dagster's job over scenes in a process of its own, as `make train` runs it."""

import os
import signal
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path

from nvsf_core.drives.catalogue import home_from_environment
from nvsf_core.stores.scene_store import require_home
from pipelines.instance import DAGSTER, make_instance

_INTERRUPTED_STATUS = 128 + signal.SIGINT
"""Exit status of what Ctrl-C has ended, as shells know it."""


def run_job(scenes: Sequence[str], recipe: str, seed: int) -> int:
    """Run the job over the scenes; returns its exit status, 130 where it was interrupted.

    Args:
        scenes: Names; none = all that have data.
        recipe: A preset's name; empty = the catalogue's choice, else `lean`.
        seed: Of training.

    Raises:
        StoreError: NVSF_HOME cannot be written to, or Dagster's instance cannot be made.
    """
    home = home_from_environment(os.environ)
    chosen = {"SCENES": " ".join(scenes), "RECIPE": recipe, "SEED": str(seed), "NVSF_HOME": str(home)}
    require_home(home)  # first: Dagster, whose history lies there, would say less of what is wrong
    place = Path(os.environ.get("DAGSTER_HOME") or home / "dagster").absolute()
    environment = os.environ | chosen | {
        "DAGSTER_HOME": str(place), "DAGSTER_MODULE_NAME": "pipelines.definitions",
        "PYTHONWARNINGS": "ignore:Function `job_execute_command`",
    }  # fmt: skip
    if list(scenes) == ["demo"]:
        # One process: to start one for each step takes longer than the steps of so short a drive.
        environment.setdefault("NVSF_EXECUTOR", "in_process")
    make_instance(place)
    # Else Dagster would look for the package in the folder it is called in, which may have one of that name.
    ours = str(Path(__file__).resolve().parents[1])
    return _status_of([*DAGSTER, "job", "execute", "-d", ours, "-j", "train_all_scenes"], environment)


def _status_of(command: Sequence[str], environment: Mapping[str, str]) -> int:
    """Exit status of a process that is interrupted with this one, and then waited for: it closes its run."""
    process, is_interrupted = subprocess.Popen(command, env=environment), False
    while True:
        try:
            status = process.wait()
            return _INTERRUPTED_STATUS if is_interrupted and status else status
        except KeyboardInterrupt:
            is_interrupted = True
            process.send_signal(signal.SIGINT)  # which a terminal has done; `kill -INT` meets one process
