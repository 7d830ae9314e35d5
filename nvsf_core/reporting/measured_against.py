"""What a run was measured against: whether its errors, and those of its views, compare with another run's."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from nvsf_core.metrics.table import HELD_OUT
from nvsf_core.metrics.trust.cues import PROTOCOL as TRUST
from nvsf_core.reporting.stage_record import StageRecord, record_of
from nvsf_core.stores.checksums import json_digest

_RECORDED = ("frames", "sweeps", "undistorted")
"""Inputs of `scene_metrics` that hold what was recorded: which frames are held out, and their truth."""


@dataclass(frozen=True, slots=True)
class MeasuredAgainst:
    """What a run was measured against."""

    frames: frozenset[int]
    """Held-out frames."""
    recorded: Mapping[str, str]
    """Stage to the content of its output, of those that hold recorded data; empty if unknown."""
    views: Mapping[str, str]
    """View with errors to a digest of what was asked for under its name, of its truth, and of its frames."""

    def compares_with(self, other: "MeasuredAgainst") -> bool:
        """Whether errors of held-out frames against this one compare with those against the other."""
        if self.recorded and other.recorded:
            return self.recorded == other.recorded
        return self.frames == other.frames

    def other_views(self, other: "MeasuredAgainst") -> frozenset[str]:
        """Views whose errors do not compare with the other's: it has none, or they are of another view."""
        return frozenset(view for view, digest in self.views.items() if other.views.get(view) != digest)


def measured_against(
    records: Sequence[StageRecord], recipe: str, seed: str, rows: Sequence[Mapping[str, Any]]
) -> MeasuredAgainst:
    """What the run of a recipe and a seed was measured against, by its rows and the scene's records."""
    record = record_of(records, "scene_metrics", recipe, seed)
    recorded = {} if record is None else {k: v for k, v in record.inputs.items() if k in _RECORDED}
    frames: dict[str, set[int]] = {}
    for row in rows:
        if row["protocol"] != TRUST:
            frames.setdefault(str(row["split"]), set()).add(int(row["frame"]))
    held_out = frozenset(frames.pop(HELD_OUT, ()))
    asked = _asked(record, record_of(records, "novel_views", recipe, seed))
    truth = None if record is None else record.facts.get("truth")
    views = {view: _digest(asked.get(view), truth, of_view) for view, of_view in frames.items()}
    return MeasuredAgainst(held_out, recorded, views)


def _asked(metrics: StageRecord | None, views: StageRecord | None) -> dict[str, Mapping[str, Any]]:
    """The keys of each view that was measured, by its name; none if the views were made anew since."""
    if metrics is None or views is None or metrics.inputs.get("novel_views") != views.content:
        return {}
    found = views.facts.get("views")
    entries = found if isinstance(found, list) else []
    return {str(one.get("name")): one for one in entries if isinstance(one, dict)}


def _digest(asked: Mapping[str, Any] | None, truth: Any, frames: set[int]) -> str:
    """SHA-256; the true images that the catalogue names decide only what is measured against them."""
    names_truth = asked is None or "truth" in asked
    return json_digest({"asked": asked, "truth": truth if names_truth else None, "frames": sorted(frames)})
