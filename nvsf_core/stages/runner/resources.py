"""What a stage takes of the machine: space on the disk, memory, and the bytes that it reads and writes."""

import ctypes
import resource
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path

from nvsf_core.errors import StoreError
from nvsf_core.stages.runner.stage import Stage, Task

SPARE_BYTES = 500_000_000
"""Left free beside what is written: Dagster's history and other runs write, too."""
_TRIM_THRESHOLD, _TOP_PAD, _MMAP_MAX = -1, -2, -4
"""Parameters of glibc's `mallopt`, by its header malloc.h."""
_NEVER_BYTES = 2**31 - 1
_MORE_BYTES = 64 * 2**20
"""Asked of the system at once."""
_IO = Path("/proc/self/io")
_MB = 1e6
_KIB = 1024


def require_space(stage: Stage, task: Task) -> None:
    """Compare a stage's estimate of what it will write with the free space of the home's disk.

    Raises:
        StoreError: It does not fit; the message has both figures.
    """
    if stage.estimate_bytes is None:
        return
    needed = stage.estimate_bytes(task)
    free = shutil.disk_usage(task.store.home).free
    if needed + SPARE_BYTES > free:
        raise StoreError(
            f"scene {task.scene.name}, stage {stage.name}: not begun, for it writes about "
            f"{needed / _MB:,.0f} MB, and {task.store.home} has {free / _MB:,.0f} MB free, of which "
            f"{SPARE_BYTES / _MB:,.0f} MB are kept; free space, or move NVSF_HOME to a larger disk"
        )


def keep_freed_memory() -> bool:
    """Let the C library give no freed memory back to the system; whether it accepted that.

    Cost volumes of a training step take some 100 MB. By default glibc maps such an array anew each time,
    and the system has to clear all its pages: an eighth of a training's time, and far more on virtual
    machines where a fault of a page is slow. The process's peak grows by a third of a training's at most;
    it is given back when the process ends. On systems without glibc nothing changes.
    """
    if not sys.platform.startswith("linux"):
        return False
    set_option = getattr(ctypes.CDLL(None), "mallopt", None)
    if set_option is None:
        return False
    wanted = ((_MMAP_MAX, 0), (_TRIM_THRESHOLD, _NEVER_BYTES), (_TOP_PAD, _MORE_BYTES))
    return all(set_option(option, value) == 1 for option, value in wanted)


class Meter:
    """Counts from its making on; files of the system's cache count as read, too."""

    def __init__(self) -> None:
        """Begin to count."""
        self._before = _moved_bytes()

    def taken(self) -> dict[str, float]:
        """`peak_memory_mb` of the process so far, and `read_mb`, `written_mb` where Linux counts them."""
        peak_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        moved = {name: count - self._before.get(name, 0) for name, count in _moved_bytes().items()}
        return {"peak_memory_mb": peak_kib * _KIB / _MB} | {
            name: count / _MB for name, count in moved.items()
        }


def in_words(taken: Mapping[str, float]) -> str:
    """What was taken, for a line of progress: whole megabytes."""
    words = {
        "peak_memory_mb": "{:.0f} MB of memory",
        "read_mb": "read {:.0f} MB",
        "written_mb": "wrote {:.0f} MB",
    }
    return ", ".join(words[name].format(value) for name, value in taken.items())


def _moved_bytes() -> dict[str, int]:
    """Bytes that this process read and wrote by system calls."""
    try:
        counts = dict(line.split(": ") for line in _IO.read_text().splitlines())
        return {"read_mb": int(counts["rchar"]), "written_mb": int(counts["wchar"])}
    except (OSError, ValueError, KeyError):
        return {}
