"""Who writes: a mark in the name of a temporary folder, by which a dead writer's leftovers are known.

Processes of other machines, or of other containers, cannot be seen from here: what they left is theirs until
nothing of it has changed for a day.
"""

import contextlib
import hashlib
import os
import re
import threading
import time
import uuid
from collections.abc import Iterator
from functools import cache
from pathlib import Path

TEMPORARY = ".publishing-"
"""Beginning of the name of what is not yet published, a folder or a file."""
FORGOTTEN_S = 86_400.0
"""Age after which what a writer elsewhere left counts as left by a dead one."""
_TOUCHED_EVERY_S = 1800.0
"""How often a live writer touches its folder: far more often than it could be forgotten."""
_MARK = re.compile(r"([0-9a-f]{8})-(\d{1,10})-(\d{1,20})-[0-9a-f]{8}$")
"""Machine, process id, start of the process in ticks, random digits."""
_DEAD_STATES = ("Z", "X")


def own_mark() -> str:
    """A mark of this process that no other call gives."""
    return f"{container_mark()}-{os.getpid()}-{_process(os.getpid())[1]}-{uuid.uuid4().hex[:8]}"


def temporary_of(target: Path) -> Path:
    """Where this process writes what is renamed to `target` once it is whole: a new path beside it."""
    return target.with_name(f"{TEMPORARY}{target.name}-{own_mark()}")


@contextlib.contextmanager
def unforgotten(folder: Path) -> Iterator[None]:
    """Touch a temporary folder from time to time meanwhile.

    A training writes nothing into it for days; what no one changes counts elsewhere as left by a dead writer.
    """
    ended = threading.Event()

    def touch() -> None:
        while not ended.wait(_TOUCHED_EVERY_S):
            with contextlib.suppress(OSError):  # a server that is away for a moment
                os.utime(folder)

    thread = threading.Thread(target=touch, name=f"touches {folder.name}", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def leftovers(folder: Path) -> Iterator[Path]:
    """What dead writers left in a folder, of whatever was to be published there."""
    for temporary in folder.glob(f"{TEMPORARY}*"):
        mark = mark_of(temporary.name)
        if mark is not None and is_left(mark, temporary):
            yield temporary


def mark_of(name: str) -> str | None:
    """The writer's mark that a name ends with; None if it has none."""
    found = _MARK.search(name)
    return None if found is None else found[0]


def is_left(mark: str, folder: Path) -> bool:
    """Whether the writer of a folder is dead: gone from here, or elsewhere without a change for a day."""
    found = _MARK.fullmatch(mark)
    if found is None or found[1] != container_mark():
        return time.time() - _newest_s(folder) > FORGOTTEN_S
    state, start = _process(int(found[2]))
    # Another process may have got the number of a dead one; it began at another time.
    return state in ("", *_DEAD_STATES) or start != found[3]


def _process(number: int) -> tuple[str, str]:
    """State of a process and its start in ticks since the machine's; empty if there is none."""
    try:
        fields = Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return "", "0"
    return fields[0], fields[19]


@cache
def machine_mark() -> str:
    """Eight digits for this machine since it was started; its containers have the same."""
    return _digits(_boot_id())


@cache
def container_mark() -> str:
    """Eight digits for this machine since it was started, and for the container in it."""
    try:
        container = os.readlink("/proc/self/ns/pid")
    except OSError:
        container = ""
    return _digits(_boot_id() + container)


def _boot_id() -> str:
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text()
    except OSError:
        return os.uname().nodename


def _digits(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:8]


def _newest_s(folder: Path) -> float:
    """The latest change of anything in a folder."""
    try:
        return max(path.lstat().st_ctime for path in (folder, *folder.rglob("*")))
    except OSError:  # its writer is alive, and has just renamed something
        return time.time()
