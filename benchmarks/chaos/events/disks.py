"""A full disk, and one that cannot be written to."""

import os
import shutil
import subprocess
from pathlib import Path

from benchmarks.chaos.event import Event, Harm, Random
from benchmarks.chaos.world import LONGEST_RUN_S, World

_FULL = r"disk refused|not begun|No space left|disk is full|disk I/O error"
_READ_ONLY = r"cannot be written|[Rr]ead-only|readonly database|unable to open database file"
_MOST_FREE = 3_000_000


def full_disk(world: World, random: Random) -> Harm:
    """Fill the disk before a run, or while it works, but for a few kilobytes to megabytes."""
    world.provoke()
    disk = world.home.parent
    free = random.randrange(_MOST_FREE // (30 if world.bare else 1))
    is_first = world.bare or random.random() < 0.5
    if is_first:
        _fill(disk, free)
    run = world.start()
    if not is_first:
        run.sleep(random.uniform(5.0, 35.0))
        _fill(disk, free)
    code = run.wait(LONGEST_RUN_S)
    (disk / "filler").unlink()
    when = "before" if is_first else "during"
    return Harm(
        f"{when} a run, {free / 1e6:.1f} MB left; exit {code}", run.said, "" if code == 0 else _FULL
    )  # fmt: skip


def _fill(disk: Path, free: int) -> None:
    """Write a file that leaves so many bytes."""
    with (disk / "filler").open("wb") as handle:
        os.posix_fallocate(handle.fileno(), 0, max(1, shutil.disk_usage(disk).free - free))


def read_only(world: World, random: Random) -> Harm:
    """Mount the disk read-only, run, and mount it for writing again."""
    world.provoke()
    disk = world.home.parent
    _remount(disk, "ro")
    run = world.start()
    code = run.wait(LONGEST_RUN_S)
    _remount(disk, "rw")
    expected = _READ_ONLY if code != 0 else "a run on a read-only disk must not succeed"
    return Harm(f"exit {code}", run.said, expected)


def _remount(disk: Path, how: str) -> None:
    subprocess.run(["mount", "-o", f"remount,{how}", str(disk)], check=True)


EVENTS = [
    Event("full_disk", "the disk is full", full_disk, needs_disk=True, weight=4),
    Event("read_only", "the home is read-only", read_only, needs_disk=True, weight=1),
]
