"""What every metric returns: a number, what it rests on, and why it is undefined where it is."""

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class Measure:
    """One metric of one frame."""

    value: float
    """The number; NaN where the metric is undefined, infinite where an error is."""
    n_valid: int
    """How many points, pixels, rays or cells it rests on."""
    reason: str = ""
    """Why it is undefined; empty where it is defined."""
    is_absent: bool = False
    """Whether it is undefined because what it needs is not there: nothing went wrong."""


def undefined(reason: str, n_valid: int = 0) -> Measure:
    """A metric without a value: NaN, and the reason."""
    return Measure(math.nan, n_valid, reason)


def absent(reason: str) -> Measure:
    """A metric that needs what is not there (weights, boxes, a modality): NaN on nothing, and the reason."""
    return Measure(math.nan, 0, reason, is_absent=True)


def fault(predicted: np.ndarray, truth: np.ndarray) -> Measure | None:
    """The undefined measure of a pair that is empty or holds a non-finite number; None for a sound pair."""
    if truth.size == 0:
        return undefined("nothing to compare with: the truth is empty")
    for side, values in (("predicted", predicted), ("true", truth)):
        broken = int(np.count_nonzero(~np.isfinite(values)))
        if broken:
            reason = f"{broken} of {values.size} {side} values are not finite"
            return undefined(reason, values.size - broken)
    return None
