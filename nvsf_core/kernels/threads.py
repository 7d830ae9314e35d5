"""How many CPU threads there are, and how work is divided among them without changing a bit of its result.

Torch divides an operation by the number of its threads, and with it the order of sums and the places where
vectors end: each number gives other bits. So torch has one thread everywhere. What is worth it is divided
into parts that never depend on the number of threads (`in_parts`); our own kernels give the same bits for
any number. Threads of torch also spin while they wait, and take the time of whatever else runs; ours sleep.
"""

import functools
import importlib
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numba
import torch

from nvsf_core.thread_count import thread_count

MOST_VIEWS = 8
"""Most views that are rendered at once."""
_BYTES_A_PIXEL, _BYTES_AT_ONCE = 400, 4 << 30
"""Memory that rendering an image takes beside what the drive takes, and that all at once may take."""
_Part = TypeVar("_Part")


def use_threads() -> None:
    """Give our kernels `thread_count()` threads in the calling thread, and torch one.

    Raises:
        RecipeError: NVSF_THREADS is not a whole number from 1 on.
    """
    torch.set_num_threads(1)
    numba.set_num_threads(min(thread_count(), numba.config.NUMBA_NUM_THREADS))


def in_parts(work: Callable[[int], _Part], parts: int, at_once: int | None = None) -> list[_Part]:
    """The results of ``work(0)`` to ``work(parts - 1)``, in order; `thread_count()` of them at once.

    A part's own parts are done one after the other, and all parts where `kernels_bear_threads` is false.

    Args:
        work: Mostly operations that release the interpreter's lock, as those of torch, numpy and numba do.
        parts: Decided by the work, never by the number of threads.
        at_once: Most parts at once, where each takes much memory.
    """
    threads = min(thread_count(), parts, parts if at_once is None else at_once)
    if threads <= 1 or getattr(_local, "is_part", False) or not kernels_bear_threads():
        return [work(part) for part in range(parts)]
    has_gradients = torch.is_grad_enabled()  # a setting of each thread

    def one(part: int) -> _Part:
        with torch.set_grad_enabled(has_gradients):
            return work(part)

    return list(_pool(threads).map(one, range(parts)))


def images_at_once(pixels: int) -> int:
    """Most images of so many pixels that are rendered at once, by memory: one of 8 million takes 3 GB."""
    return max(1, min(MOST_VIEWS, _BYTES_AT_ONCE // (_BYTES_A_PIXEL * pixels)))


def other_threads(most: int) -> ThreadPoolExecutor:
    """At most `most` threads that work while the calling thread does something else: one less than there are.

    At least one, even where the calling thread then waits for it.
    """
    threads = min(most, thread_count() - 1) if kernels_bear_threads() else 1
    return ThreadPoolExecutor(max(1, threads), "nvsf-ahead", initializer=_begin)


@functools.cache
def kernels_bear_threads() -> bool:
    """Whether several threads may call our kernels at once: whether numba finds OpenMP, that is, libgomp1.

    Without it numba ends a process whose second thread calls a kernel.
    """
    try:
        importlib.import_module("numba.np.ufunc.omppool")
    except ImportError:
        return False
    return True


_local = threading.local()


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, "nvsf-part", initializer=_begin)


def _begin() -> None:
    """Make the calling thread one that works on parts: it has no threads of its own."""
    _local.is_part = True
    torch.set_num_threads(1)
    numba.set_num_threads(1)
