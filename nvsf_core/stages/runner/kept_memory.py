"""Keeps freed memory in the process, so that large arrays do not fetch every page from the system again."""

import ctypes
import sys

_TRIM_THRESHOLD, _TOP_PAD, _MMAP_MAX = -1, -2, -4
"""Parameters of glibc's `mallopt`, by its header malloc.h."""
_NEVER_BYTES = 2**31 - 1
_MORE_BYTES = 64 * 2**20
"""Asked of the system at once."""


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
