"""Compares candidates on validation data: scans or images of the training frames that were left out.

A learned part is used only where it beats its baseline here. Test frames are never among the data.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from nvsf_core._types import Scalar
from nvsf_core.kernels.threads import MOST_VIEWS, in_parts

Left = TypeVar("Left")
_LEAST_ERROR = 1e-9
"""For ratios of errors."""
_SURE = 2.0
"""Standard errors by which a mean gain must exceed zero."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """Mean scores of candidates on the same validation data."""

    metrics: tuple[str, ...]
    """Names, with their units: `_db` of a PSNR; else, if higher is better, a share."""
    higher_is_better: tuple[bool, ...]
    means: Mapping[str, tuple[float, ...]]
    """The means of each candidate, in the order of the metrics."""

    def of(self, candidate: str, metric: str) -> float:
        """The mean of a candidate in a metric."""
        return self.means[candidate][self.metrics.index(metric)]

    def is_better(self, candidate: str, metric: str, other: str) -> bool:
        """Whether a candidate is better than another in a metric; NaN is never better."""
        ours, theirs = self.of(candidate, metric), self.of(other, metric)
        return ours > theirs if self.higher_is_better[self.metrics.index(metric)] else ours < theirs

    def wins(self, candidate: str, other: str) -> bool:
        """Whether a candidate's errors are smaller than another's, in the geometric mean of all metrics.

        So a large gain in one metric counts for more than small losses in others. A metric in which either is
        undefined does not count; where most are, nobody wins.
        """
        gains = [math.log(self._error(other, m) / self._error(candidate, m)) for m in self.metrics]
        defined = [gain for gain in gains if not math.isnan(gain)]
        return len(defined) > len(self.metrics) // 2 and sum(defined) > 0.0

    def _error(self, candidate: str, metric: str) -> float:
        """A mean as an error, positive: of a PSNR the root mean square, of a share (0..1) what is missing."""
        value = self.of(candidate, metric)
        if metric.endswith("_db"):
            return float(10.0 ** (-value / 20.0))
        return max(1.0 - value if self.higher_is_better[self.metrics.index(metric)] else value, _LEAST_ERROR)

    def figures(self, prefixes: Mapping[str, str]) -> dict[str, Scalar]:
        """Means as metadata, under the metric's name after the candidate's prefix in `prefixes`."""
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
    """Score candidates on validation data and take the means.

    Args:
        metrics: For each metric (its name with its unit), whether higher is better.
        validation: At least one scan or image.
        candidates: For each name, a function that scores one of them, in the order of the metrics.
    """
    kept_out = list(validation)
    # All together: threads wait for the last of them once, not once a candidate.
    work = [(score, one) for score in candidates.values() for one in kept_out]
    scores = in_parts(lambda number: work[number][0](work[number][1]), len(work), MOST_VIEWS)
    by_candidate = np.reshape(scores, (len(candidates), len(kept_out), len(metrics))).mean(axis=1)
    means = dict(zip(candidates, (tuple(row) for row in by_candidate.tolist()), strict=True))
    return Comparison(tuple(metrics), tuple(metrics.values()), means)


def validation_numbers(count: int, every: int, first: int) -> range:
    """Which of `count` items are for validation: every `every`-th from `first`; at least one, never all."""
    return range(min(first, count // 2), count, every)


def is_sure(gains: Sequence[float]) -> bool:
    """Whether the mean of at least two gains is above zero by more than two standard errors."""
    return bool(np.mean(gains) > _SURE * np.std(gains, ddof=1) / np.sqrt(len(gains)))
