"""Which errors of asked views compare: a view can be changed under the same name between two runs."""

from collections.abc import Iterable

from benchmarks.common.documents import Row
from nvsf_core.metrics.table import BASELINES, HELD_OUT

_NEWEST = BASELINES[0]
"""The baseline that every run measures: its row is the newest run's."""


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
