"""Training data kept out to choose by: candidates show the same scans or images, and the better one is shown.

Whatever is learned is asked here whether it beats what needs no learning. Held-out (test) frames are never
among the data.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from nvsf_core._types import Scalar

Left = TypeVar("Left")
_SURE = 2.0
"""Standard errors by which a mean gain must exceed none."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """Mean scores of candidates on the same validation data."""

    metrics: tuple[str, ...]
    """Their names, units in them."""
    higher_is_better: tuple[bool, ...]
    means: Mapping[str, tuple[float, ...]]
    """Candidate to its means, in the order of the metrics."""

    def of(self, candidate: str, metric: str) -> float:
        """One mean."""
        return self.means[candidate][self.metrics.index(metric)]

    def is_better(self, candidate: str, metric: str, other: str) -> bool:
        """Whether a candidate is better than another in a metric; what is undefined is not better."""
        ours, theirs = self.of(candidate, metric), self.of(other, metric)
        return ours > theirs if self.higher_is_better[self.metrics.index(metric)] else ours < theirs

    def wins(self, candidate: str, other: str) -> bool:
        """Whether a candidate is better than another in most metrics."""
        better = sum(self.is_better(candidate, metric, other) for metric in self.metrics)
        return better > len(self.metrics) // 2

    def figures(self, prefixes: Mapping[str, str]) -> dict[str, Scalar]:
        """All means for a table; `prefixes` (candidate to what its keys begin with) says which and how."""
        return {
            f"{prefix}{metric}": "undefined" if np.isnan(value) else value
            for candidate, prefix in prefixes.items()
            for metric, value in zip(self.metrics, self.means[candidate], strict=True)
        }


def compare(
    metrics: Mapping[str, bool],
    validation: Iterable[Left],
    candidates: Mapping[str, Callable[[Left], Sequence[float]]],
) -> Comparison:
    """Score candidates on validation data.

    Args:
        metrics: Name, with its unit, to whether higher is better.
        validation: At least one scan or image that was kept out.
        candidates: Name to a function that shows one of them and gives its scores, in the metrics' order.
    """
    kept_out = list(validation)
    means = {
        name: tuple(np.mean([score(one) for one in kept_out], axis=0).tolist())
        for name, score in candidates.items()
    }
    return Comparison(tuple(metrics), tuple(metrics.values()), means)


def validation_numbers(count: int, every: int, first: int) -> range:
    """Which of `count` are kept out: every so many-th, from the first on; at least one, never all."""
    return range(min(first, count // 2), count, every)


def is_sure(gains: Sequence[float]) -> bool:
    """Whether the mean of at least two gains exceeds none by two standard errors."""
    return bool(np.mean(gains) > _SURE * np.std(gains, ddof=1) / np.sqrt(len(gains)))
