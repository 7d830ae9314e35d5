"""Errors by support, pooled over frames, sensors and views: each ray, point or pixel counts once.

A mean over frames would give the few guessed pixels of one image the weight of all of another.
"""

import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from nvsf_core.rendering.rendered import Support


class Pooled(NamedTuple):
    """A metric over all rays, points or pixels of one support."""

    value: float
    """NaN without any."""
    n_valid: int
    """How many there are."""


def pool_by_support(rows: Iterable[Mapping[str, Any]], protocol: str, metric: str) -> dict[Support, Pooled]:
    """A metric by support, from seen to guessed; decibels are pooled as mean squares.

    Of rows of `scene_metrics` of one recipe and seed; those of other metrics and regions are ignored.
    """
    mine = [row for row in rows if (row["protocol"], row["metric"]) == (protocol, metric)]
    return {
        support: _pooled([row for row in mine if row["region"] == support.region], metric)
        for support in reversed(Support)
    }


def _pooled(rows: Iterable[Mapping[str, Any]], metric: str) -> Pooled:
    known = [(row["n_valid"], row["value"]) for row in rows if math.isfinite(row["value"])]
    count, value = np.array(known, np.float64).reshape(-1, 2).T
    if count.sum() == 0:
        return Pooled(math.nan, 0)
    if metric.endswith("_db"):
        squared = np.sum(count * 10.0 ** (-value / 10.0)) / count.sum()
        return Pooled(float(-10.0 * np.log10(squared)), int(count.sum()))
    return Pooled(float(np.sum(count * value) / count.sum()), int(count.sum()))
