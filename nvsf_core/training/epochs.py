"""Sampling without replacement: every example once, in a random order, before any comes again."""

import functools

import numpy as np
import torch
from torch import Tensor


class Epochs:
    """An endless sequence of examples' numbers: all of them in one random order, then in another, and so on.

    Of n examples drawn n times with replacement, over a third is never drawn; of these, none. Threads may
    share it.
    """

    def __init__(self, count: int, seed: int) -> None:
        """Of `count` examples, at least one, in orders that the seed decides."""
        self._count, self._seed = count, seed
        # A part of the sequence lies in an epoch or across the border of two.
        self._order = functools.lru_cache(maxsize=2)(self._shuffled)

    def part(self, number: int, length: int) -> Tensor:
        """(length,) int64: the sequence is cut into parts of a length; the one of this number, from 0."""
        found, first, end = list[Tensor](), number * length, (number + 1) * length
        while first < end:
            epoch, place = divmod(first, self._count)
            found.append(self._order(epoch)[place : place + end - first])
            first += len(found[-1])
        return torch.cat(found)

    def _shuffled(self, epoch: int) -> Tensor:
        # Of a seed torch uses 32 bits.
        seed = int(np.random.SeedSequence((self._seed, epoch)).generate_state(1)[0])
        return torch.randperm(self._count, generator=torch.Generator().manual_seed(seed))
