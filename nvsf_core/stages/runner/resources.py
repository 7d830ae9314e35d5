"""What a stage takes of the machine: its memory at most, and the bytes that it reads and writes."""

import resource
from collections.abc import Mapping
from pathlib import Path

_IO = Path("/proc/self/io")
_MB = 1e6
_KIB = 1024


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
