"""What a training's later steps need, prepared by CPU threads while a GPU computes an earlier step."""

from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from types import TracebackType
from typing import Generic, TypeVar

import torch

from nvsf_core.kernels.threads import other_threads
from nvsf_core.training.loop import seeds_of_parts

_STEPS_AHEAD = 8
_MOST_THREADS = 4
"""Enough to prepare a step's input while a GPU computes one; all take turns at the interpreter's lock with
the thread that starts the GPU's kernels."""
_Prepared = TypeVar("_Prepared")


class Ahead(Generic[_Prepared]):
    """A step's input, prepared ahead: the same as if it were prepared when it is taken. A context.

    What a step draws is decided by its generator alone, so a copy of the generator knows what later steps
    will draw. A step that is repeated, or the first after a checkpoint, draws something else than what was
    prepared; then all that was prepared is left aside.
    """

    def __init__(self, parts: int, prepare: Callable[[Sequence[torch.Generator]], _Prepared]) -> None:
        """Nothing is prepared before the first step.

        Args:
            parts: Generators of a step, as of `side_by_side`.
            prepare: Gives a step's input from the generators of its parts. Called by several threads.
        """
        self._parts, self._prepare = parts, prepare
        self._threads = other_threads(_MOST_THREADS)
        self._copy = torch.Generator()
        self._coming: deque[tuple[list[int], Future[_Prepared]]] = deque()

    def __enter__(self) -> "Ahead[_Prepared]":
        """Itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the threads; what was prepared is left aside."""
        self._threads.shutdown(cancel_futures=True)

    def take(self, generator: torch.Generator) -> _Prepared:
        """The input of the step that `generator` (on the CPU) is of."""
        state = generator.get_state()
        seeds = seeds_of_parts(self._parts, generator)
        if not self._coming or self._coming[0][0] != seeds:
            self._coming.clear()
            self._copy.set_state(state)
        while len(self._coming) <= _STEPS_AHEAD:
            ahead = seeds_of_parts(self._parts, self._copy)
            self._coming.append((ahead, self._threads.submit(self._of_seeds, ahead)))
        return self._coming.popleft()[1].result()

    def _of_seeds(self, seeds: list[int]) -> _Prepared:
        return self._prepare([torch.Generator().manual_seed(seed) for seed in seeds])
