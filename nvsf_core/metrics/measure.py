"""The result of a metric: its value, over how many elements, and the reason where it is undefined."""

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class Measure:
    """One metric of one frame."""

    value: float
    """NaN where the metric is undefined, infinite where the error is."""
    n_valid: int
    """Number of points, pixels, rays or cells it is computed from."""
    reason: str = ""
    """Why it is undefined; empty if it is defined."""
    is_absent: bool = False
    """Whether it is undefined because its input does not exist, which is no error."""


def undefined(reason: str, n_valid: int = 0) -> Measure:
    """An undefined metric: NaN, and the reason."""
    return Measure(math.nan, n_valid, reason)


def absent(reason: str) -> Measure:
    """A metric whose input does not exist (weights, boxes, a modality): NaN, and the reason."""
    return Measure(math.nan, 0, reason, is_absent=True)


def fault(predicted: np.ndarray, truth: np.ndarray) -> Measure | None:
    """The undefined measure of two arrays of any one shape if the truth is empty or a number is not finite.

    None for others.
    """
    if truth.size == 0:
        return undefined("nothing to compare with: the truth is empty")
    for side, values in (("predicted", predicted), ("true", truth)):
        broken = int(np.count_nonzero(~np.isfinite(values)))
        if broken:
            reason = f"{broken} of {values.size} {side} values are not finite"
            return undefined(reason, values.size - broken)
    return None
