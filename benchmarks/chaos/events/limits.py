"""A full disk, one that cannot be written to, clocks that jump, and too little memory."""

import os
import shutil
import subprocess
from pathlib import Path

from benchmarks.chaos.event import Event, Harm, Random
from benchmarks.chaos.world import LONGEST_RUN_S, World

_FULL = r"disk refused|not begun|No space left|disk is full|disk I/O error"
_READ_ONLY = r"cannot be written|[Rr]ead-only|readonly database|unable to open database file"
_MOST_FREE = 3_000_000
_YEAR_S = 365 * 86_400.0
_FAKETIME = sorted(Path("/usr/lib").glob("*/faketime/libfaketimeMT.so.1"))
"""The package libfaketime, where it is installed."""
_GROUPS = Path("/sys/fs/cgroup/memory")
"""Version 1 of control groups, where it is mounted."""
_KILLED = r"died twice|exited with|Killed|signal|memory|MemoryError|allocate|next: open the report"


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


def file_times(world: World, random: Random) -> Harm:
    """Set the times of all files of the drive and the outputs to another year; nothing is made again."""
    moment_s = random.choice([0.0, 10 * _YEAR_S, 130 * _YEAR_S])
    for folder in (world.folder / "drive", world.plan().store.root):
        for path in folder.rglob("*"):
            os.utime(path, (moment_s, moment_s))
    run = world.start()
    code = run.wait(LONGEST_RUN_S)
    skipped = run.said.count("up to date, skipped")
    how = f"to {1970 + moment_s / _YEAR_S:.0f}; {skipped} of {len(world.stages)} skipped; exit {code}"
    expected = "up to date" if skipped == len(world.stages) else "all must be skipped"
    return Harm(how, run.said, expected)


def same_time(world: World, random: Random) -> Harm:
    """Change bytes of the drive, and set the file's times as they were: it must be read again."""
    path = world.drive.scan_path(random.choice([0, 1, 3]))
    times, content = path.stat(), bytearray(path.read_bytes())
    content[12:16] = b"\x00\x00\x00\x3f"
    path.write_bytes(content)
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
    run = world.start()
    code = run.wait(LONGEST_RUN_S)
    world.restore_drive()
    return Harm(f"exit {code}", run.said, r"made again, for the files of the drive changed")


def other_clock(world: World, random: Random) -> Harm:
    """Run with a clock that is days or years off; the next run has the right one again."""
    world.provoke()
    days = random.choice([-400, -1, 1, 400])
    run = world.start(LD_PRELOAD=str(_FAKETIME[0]), FAKETIME=f"{days:+d}d", FAKETIME_DONT_FAKE_MONOTONIC="1")
    code = run.wait(LONGEST_RUN_S)
    return Harm(f"{days:+d} days; exit {code}", run.said, "report  " if code == 0 else "must succeed")


def little_memory(world: World, random: Random) -> Harm:
    """Run within a control group that has too little memory, or little more: the kernel kills a process."""
    world.provoke()
    megabytes = random.choice([350, 500, 700, 900, 1200])
    group = _GROUPS / f"nvsf-chaos-{os.getpid()}"
    group.mkdir(exist_ok=True)
    (group / "memory.limit_in_bytes").write_text(str(megabytes << 20))
    shell = shutil.which("sh") or "/bin/sh"
    prefix = (shell, "-c", f'echo $$ > {group}/cgroup.procs; exec "$0" "$@"')
    run = world.start(prefix, NVSF_EXECUTOR=random.choice(["in_process", "multiprocess"]))
    code = run.wait(LONGEST_RUN_S)
    return Harm(f"{megabytes} MB; exit {code}", run.said, "" if code in (-9, 137) else _KILLED)


EVENTS = [
    Event("full_disk", "the disk is full", full_disk, needs_disk=True, weight=4),
    Event("read_only", "the home is read-only", read_only, needs_disk=True, weight=1),
    Event("file_times", "all file times jump", file_times, weight=1),
    Event("same_time", "bytes of the drive change, its times do not", same_time, weight=1),
    *([Event("other_clock", "a run whose clock is off", other_clock, needs_dagster=True)] * bool(_FAKETIME)),
    *(
        [Event("little_memory", "too little memory", little_memory, needs_dagster=True)]
        * (os.geteuid() == 0 and (_GROUPS / "memory.limit_in_bytes").exists())
    ),
]
