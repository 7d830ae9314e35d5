"""A lock that allows one training at a time per device; the CPU counts as one device.

It is a lock of the operating system (`flock`), which is free again as soon as its holder dies, even by
SIGKILL. Slots that a scheduler counts would stay taken.
"""

import contextlib
import fcntl
import os
import time
from collections.abc import Iterator
from pathlib import Path

from nvsf_core.errors import StoreError
from nvsf_core.stages.runner.stage import Progress

_POLL_S = 0.2
_SAY_EVERY_S = 5.0


@contextlib.contextmanager
def device_lock(folder: Path, progress: Progress) -> Iterator[str]:
    """Wait for this process's device and hold its lock; yields its name (`cpu`, `cuda0`, ...).

    `folder` has one lock file per device; processes that share devices must share the folder. A process
    trains on its first visible GPU: on a machine with several, give each worker its CUDA_VISIBLE_DEVICES.

    Raises:
        StoreError: The lock file's path is a folder or a pipe.
    """
    folder.mkdir(parents=True, exist_ok=True)
    device = _device()
    path = folder / f"{device}.lock"
    if os.path.lexists(path) and not path.is_file():
        raise StoreError(f"{path}: expected a lock file, found a folder or a pipe; delete it and run again")
    with path.open("a") as handle:
        started_s = time.monotonic()
        said_s = -_SAY_EVERY_S
        while not _locked(handle.fileno()):
            waited_s = time.monotonic() - started_s
            if waited_s - said_s >= _SAY_EVERY_S:
                progress(f"waiting for the device {device}: another training holds it ({waited_s:.0f} s)")
                said_s = waited_s
            time.sleep(_POLL_S)
        yield device


def _locked(descriptor: int) -> bool:
    """Try to lock; closing the file, or the end of the process, unlocks."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _device() -> str:
    """The first CUDA device that this process may see, else `cpu`; found without initialising CUDA."""
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible is None:
        ids = sorted(path.name.removeprefix("nvidia") for path in Path("/dev").glob("nvidia[0-9]*"))
    else:
        ids = [part.strip() for part in visible.split(",") if part.strip() not in ("", "-1")]
    return f"cuda{ids[0]}" if ids else "cpu"
