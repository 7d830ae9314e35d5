"""What a training's later steps need, prepared by CPU threads while a GPU computes an earlier step."""

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import AbstractContextManager
from typing import Generic, TypeVar

from nvsf_core.kernels.threads import other_threads

_STEPS_AHEAD = 8
_MOST_THREADS = 4
"""Enough to prepare a step's input while a GPU computes one; all take turns at the interpreter's lock with
the thread that starts the GPU's kernels."""
_Prepared = TypeVar("_Prepared")


class Ahead(AbstractContextManager, Generic[_Prepared]):
    """A step's input, prepared ahead: the same as if it were prepared when it is taken. A context.

    After a step that is repeated, or the first after a checkpoint, others follow than were prepared; then all
    that was prepared is left aside.
    """

    def __init__(self, prepare: Callable[[int], _Prepared]) -> None:
        """Prepare nothing before the first step; the number of a step alone decides its input."""
        self._prepare = prepare
        self._threads = other_threads(_MOST_THREADS)
        self._coming: deque[tuple[int, Future[_Prepared]]] = deque()

    def __exit__(self, *error: object) -> None:
        """End the threads; what was prepared is left aside."""
        self._threads.shutdown(cancel_futures=True)

    def take(self, step: int) -> _Prepared:
        """The input of a step."""
        if not self._coming or self._coming[0][0] != step:
            self._coming.clear()
        while len(self._coming) <= _STEPS_AHEAD:
            later = step + len(self._coming)
            self._coming.append((later, self._threads.submit(self._prepare, later)))
        return self._coming.popleft()[1].result()
