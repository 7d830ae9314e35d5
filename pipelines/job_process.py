"""Dagster's job over scenes in a process of its own, as `make train` runs it."""

import os
import signal
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import FrameType

from nvsf_core.drives.catalogue import home_from_environment
from nvsf_core.errors import StoreError
from nvsf_core.stages.runner.run import find_scene, say_on_stderr
from nvsf_core.stores.scene_store import require_home, why_not_writable
from pipelines.instance import DAGSTER, instance_place, make_instance

INTERRUPTED = "interrupted. Run it again to go on: what was finished is skipped, and training resumes"
"""What a run says at its end that Ctrl-C or SIGTERM has stopped."""
_ENDS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
"""By Ctrl-C, by `kill`, by a terminal that is closed, by Ctrl-\\."""


def run_job(scenes: Sequence[str], recipe: str, seed: int) -> int:
    """Run the job over the scenes; returns its exit status, 130 after Ctrl-C and 143 after SIGTERM.

    Args:
        scenes: Names; none = all that have data.
        recipe: A preset's name; empty = the catalogue's choice, else `lean`.
        seed: Of training.

    Raises:
        DataError: The catalogue has no scene of such a name; nothing was started.
        StoreError: NVSF_HOME or DAGSTER_HOME cannot be written to, or Dagster's instance cannot be made.
    """
    for name in scenes:
        find_scene(name)
    home = home_from_environment(os.environ)
    chosen = {"SCENES": " ".join(scenes), "RECIPE": recipe, "SEED": str(seed), "NVSF_HOME": str(home)}
    require_home(home)  # first: Dagster, whose history lies there, would say less of what is wrong
    place = instance_place(os.environ)
    environment = os.environ | chosen | {
        "DAGSTER_HOME": str(place), "DAGSTER_MODULE_NAME": "pipelines.definitions",
        "PYTHONWARNINGS": "ignore:Function `job_execute_command`",
    }  # fmt: skip
    if list(scenes) == ["demo"] and not environment.get("NVSF_EXECUTOR"):
        # One process: to start one for each step takes longer than the steps of so short a drive.
        environment["NVSF_EXECUTOR"] = "in_process"
    make_instance(place)
    fault = why_not_writable(place)
    if fault is not None:
        raise StoreError(f"DAGSTER_HOME={place}: expected a folder to write to, found one {fault}")
    # Else Dagster would look for the package in the folder it is called in, which may have one of that name.
    ours = str(Path(__file__).resolve().parents[1])
    return _status_of([*DAGSTER, "job", "execute", "-d", ours, "-j", "train_all_scenes"], environment)


def _status_of(command: Sequence[str], environment: Mapping[str, str]) -> int:
    """Exit status of a process that ends where this one is asked to: it closes its run, and is waited for.

    A terminal signals to a whole group, and what Dagster starts to copy its logs would answer Ctrl-C by a
    stack trace each: they have a group of their own, and Dagster ends them.
    """
    asked: list[int] = []
    process: subprocess.Popen[bytes] | None = None

    def end(number: int, _: FrameType | None) -> None:
        asked.append(number)
        if process is not None:
            process.terminate()  # Dagster takes it as Ctrl-C

    def stop(_: int, __: FrameType | None) -> None:
        if process is not None:
            os.killpg(process.pid, signal.SIGSTOP)
            os.kill(os.getpid(), signal.SIGSTOP)  # from here it goes on after `fg`
            os.killpg(process.pid, signal.SIGCONT)

    for number, heed in (*((one, end) for one in _ENDS), (signal.SIGTSTP, stop)):
        if signal.getsignal(number) != signal.SIG_IGN:  # as `nohup` and the background of a script have it
            signal.signal(number, heed)
    process = subprocess.Popen(command, env=environment, process_group=0)
    if asked:
        process.terminate()
    status = process.wait()
    if asked and status == -signal.SIGTERM:  # before it had a run to close
        say_on_stderr(INTERRUPTED)
    return 128 + asked[0] if asked and status else status
