"""Locks of files: what two runs must not do at once, and one training at a time per device of a machine.

They are locks of the operating system (`flock`), which are free again as soon as their holder dies, even by
SIGKILL. Slots that a scheduler counts would stay taken. Where a file system shares them between machines, as
NFSv4 does, they hold between machines.
"""

import contextlib
import fcntl
import os
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

from nvsf_core.errors import StoreError
from nvsf_core.stages.runner.stage import Progress
from nvsf_core.stores.writers import container_mark, machine_mark

LOCKS = ".leases"
"""Folder below a home of all lock files."""
_POLL_S = 0.2
_SAY_EVERY_S = 5.0


@contextlib.contextmanager
def file_lock(path: Path, progress: Progress, awaited: str, *, shared: bool = False) -> Iterator[None]:
    """Wait for the lock of a file, which is made where it is absent, and hold it.

    Args:
        path: The lock file; it holds nothing.
        progress: Told every few seconds of waiting.
        awaited: What is waited for, and who has it, in words.
        shared: Whether other readers may hold it, too; a writer waits for all of them.

    Raises:
        StoreError: The lock file's path is a folder or a pipe.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if os.path.lexists(path) and not path.is_file():
        raise StoreError(f"{path}: expected a lock file, found a folder or a pipe; delete it and run again")
    kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
    # Open for both: a server of files wants to write for the one kind and to read for the other.
    with path.open("a+") as handle:
        started_s = time.monotonic()
        said_s = -_SAY_EVERY_S
        while not _locked(handle.fileno(), kind):
            waited_s = time.monotonic() - started_s
            if waited_s - said_s >= _SAY_EVERY_S:
                progress(f"waiting for {awaited} ({waited_s:.0f} s)")
                said_s = waited_s
            time.sleep(_POLL_S)
        yield


@contextlib.contextmanager
def free_lock(path: Path) -> Iterator[bool]:
    """Hold the lock of a file if nobody else has it; yields whether it is held. Nothing is waited for."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a+") as handle:
        yield _locked(handle.fileno(), fcntl.LOCK_EX)


@contextlib.contextmanager
def output_locks(
    folder: Path, written: str | None, read: Iterable[str], progress: Progress
) -> Iterator[None]:
    """Hold the locks of outputs that are read and, if one is, of the one that is written.

    All processes take them in the order of the flow, so that none waits for another that waits for it.

    Args:
        folder: Of the scene's lock files.
        written: Place of the output below the scene's folder; None if none is.
        read: Places of what is read, in the order of the flow.
        progress: Told every few seconds of waiting.
    """
    with contextlib.ExitStack() as held:
        for place in read:
            words = f"{place}, which another run writes"
            held.enter_context(file_lock(folder / f"{place}.lock", progress, words, shared=True))
        if written is not None:
            words = f"{written}, which another run writes or reads"
            held.enter_context(file_lock(folder / f"{written}.lock", progress, words))
        yield


def _locked(descriptor: int, kind: int) -> bool:
    """Try to lock; closing the file, or the end of the process, unlocks."""
    try:
        fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


@contextlib.contextmanager
def device_lock(folder: Path, progress: Progress) -> Iterator[str]:
    """Wait for this process's device and hold its lock; yields its name (`cpu`, `cuda0`, ...).

    `folder` has one lock file per device; processes that share devices must share the folder. A process
    trains on its first visible GPU: on a machine with several, give each worker its CUDA_VISIBLE_DEVICES.

    Raises:
        StoreError: The lock file's path is a folder or a pipe.
    """
    device = _device()
    words = f"the device {device}: another training holds it"
    with file_lock(lock_file(folder), progress, words):
        yield device


def lock_file(folder: Path) -> Path:
    """The lock file of this process's device; machines that share the folder have files of their own."""
    device = _device()
    # A pod has cores of its own, by its limits: it need not wait for another one on its node.
    is_pod = device == "cpu" and os.environ.get("NVSF_EXECUTOR") == "k8s"
    return folder / f"{device}-{container_mark() if is_pod else machine_mark()}.lock"


def _device() -> str:
    """The first CUDA device that this process may see, else `cpu`; found without initialising CUDA."""
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible is None:
        ids = sorted(path.name.removeprefix("nvidia") for path in Path("/dev").glob("nvidia[0-9]*"))
    else:
        ids = [part.strip() for part in visible.split(",") if part.strip() not in ("", "-1")]
    return f"cuda{ids[0]}" if ids else "cpu"
