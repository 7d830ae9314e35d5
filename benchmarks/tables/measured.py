"""What the tables of results show: errors of a method on a scene, over its frames, cameras and seeds."""

import math
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from benchmarks.common.documents import Row
from nvsf_core.metrics.table import BASELINES, HELD_OUT, method_rank

LOWER, HIGHER = "↓", "↑"
"""Which way is better."""


class Column(NamedTuple):
    """A metric of a table."""

    metric: str
    title: str
    digits: int
    way: str = LOWER
    """Which way is better."""

    @property
    def head(self) -> str:
        """Over the column."""
        return f"{self.title} {self.way}"

    @property
    def sign(self) -> float:
        """What makes of a value one of which less is better."""
        return 1.0 if self.way == LOWER else -1.0

    def keeps(self, value: float, limit: float) -> bool:
        """Whether a value is at least as good as a limit; a NaN is not, and nothing is as good as a NaN."""
        return self.sign * value <= self.sign * limit

    def order(self, error: "Error") -> tuple[int, float]:
        """What is less of a better error: a mean over fewer frames than another is the worse of both."""
        return error.n_undefined, self.sign * error.mean


class Error(NamedTuple):
    """A mean over frames, cameras and seeds."""

    mean: float
    """NaN where it is undefined or was not measured."""
    n_undefined: int
    """Frames that are not in it, summed over the cameras; of the seed that has most."""

    @property
    def is_known(self) -> bool:
        """Whether there is a mean."""
        return not math.isnan(self.mean)


_NEWEST = BASELINES[0]
"""The baseline that every run measures: its row is the newest run's."""
UNKNOWN = Error(math.nan, 0)
"""Of what was not measured."""


@dataclass(frozen=True, slots=True)
class Measured:
    """One method on one scene."""

    rows: list[Row]
    """One a seed; of a baseline, which has none, one in all."""
    seeds: str
    """How many, in a table's words."""

    def errors(self, protocol: str, metric: str, split: str = HELD_OUT) -> list[float | None]:
        """Of each seed, see `error_of`."""
        return [error_of(row, protocol, metric, split) for row in self.rows]

    def error(self, protocol: str, metric: str, split: str = HELD_OUT) -> Error:
        """Over all seeds."""
        n_undefined = [sum(_of(row.get("undefined", {}), protocol, metric, split)) for row in self.rows]
        return Error(mean_of(self.errors(protocol, metric, split)), max(n_undefined))

    def cell(self, protocol: str, column: Column, split: str = HELD_OUT) -> str:
        """An error in a table; * marks a mean over fewer frames than there are."""
        error = self.error(protocol, column.metric, split)
        text = cell(self.errors(protocol, column.metric, split), column.digits)
        return f"{text}*" if error.is_known and error.n_undefined else text


def by_method(rows: Iterable[Row]) -> dict[tuple[str, str], Measured]:
    """Scene and method to their rows, in a table's order."""
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["scene"], row["method"]), []).append(row)
    return {
        key: Measured(groups[key], "" if key[1] in BASELINES else str(len(groups[key])))
        for key in sorted(groups, key=lambda key: (key[0], *rank(key[1])))
    }


def rank(method: str) -> tuple[int, str]:
    """Models by name, then the baselines in their own order."""
    return method_rank(method), method


def error_of(row: Row, protocol: str, metric: str, split: str = HELD_OUT) -> float | None:
    """A row's error, of images the mean over its cameras; None where it is undefined or was not measured."""
    found = _of(row["errors"], protocol, metric, split)
    return statistics.fmean(found) if found and None not in found else None


def _of(by_place: dict[str, dict[str, Any]], protocol: str, metric: str, split: str) -> list[Any]:
    """What is stored of a metric, sensor by sensor."""
    region = "foreground" if protocol == "masked" else "all"
    return [
        of_metric[metric]
        for place, of_metric in by_place.items()
        if place.startswith(f"{split}/{protocol}/{region}/") and metric in of_metric
    ]


def mean_of(values: Sequence[float | None]) -> float:
    """Mean of the known values; NaN if there is none."""
    known = [value for value in values if value is not None]
    return statistics.fmean(known) if known else math.nan


def cell(values: Sequence[float | None], digits: int) -> str:
    """Mean and spread over seeds; - where nothing is known, no spread where a mean is infinite."""
    known = [value for value in values if value is not None]
    if not known:
        return "-"
    has_spread = len(known) > 1 and all(math.isfinite(value) for value in known)
    spread = f" ± {statistics.stdev(known):.{digits}f}" if has_spread else ""
    return f"{statistics.fmean(known):,.{digits}f}{spread}"


def commits_of(rows: Iterable[Row]) -> str:
    """Short commits, oldest row first."""
    return " ".join(dict.fromkeys(row["commit"][:7] for row in rows))


def of_same_views(rows: Iterable[Row]) -> tuple[list[Row], dict[str, list[str]]]:
    """Rows without the errors of views that were other ones than the scene's newest run has.

    Rows without `views`, as older files have them, are kept as they are.

    Returns:
        The rows, and by scene what was left out, in words.
    """
    found = list(rows)
    newest = {row["scene"]: row.get("views") for row in found if row["method"] == _NEWEST}
    kept: list[Row] = []
    left_out: dict[str, list[str]] = {}
    for row in found:
        others = _other_views(row.get("views"), newest.get(row["scene"]))
        errors = {place: error for place, error in row["errors"].items() if _view(place) not in others}
        kept.append(row | {"errors": errors})
        words = f"`{row['method']}`" + ("" if row["method"] in BASELINES else f", seed {row['seed']}")
        left_out.setdefault(row["scene"], []).extend(f"`{view}` of {words}" for view in others)
    return kept, left_out


def _other_views(views: dict[str, str] | None, newest: dict[str, str] | None) -> list[str]:
    if views is None or newest is None:
        return []
    return sorted(view for view, digest in views.items() if newest.get(view) != digest)


def _view(place: str) -> str:
    """The view of a key of `errors`; empty for the held-out frames."""
    split = place.split("/")[0]
    return "" if split == HELD_OUT else split
