"""Collect the rows of `scene_metrics`, and sum them up as the stage's metadata and checks."""

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from nvsf_core._types import Scalar
from nvsf_core.metrics.measure import Measure
from nvsf_core.metrics.table import BASELINES, HELD_OUT, UNITS, mean_rows, summary_table
from nvsf_core.stages.checks.declared import DEFINED
from nvsf_core.stages.runner.stage import Check, StageOutput

_HEADLINES = {
    (HELD_OUT, "all"): (
        ("lidar4d_scan", "chamfer_m2"), ("lidar4d_scan", "f_score"), ("lidar4d_scan", "range_psnr_db"),
        ("raw", "range_abs_error_median_m"), ("raw", "hit_accuracy"), ("image", "image_psnr_db"),
    ),
    (HELD_OUT, "foreground"): (
        ("lidar4d", "chamfer_m2"), ("lidar4d", "range_rmse_m"), ("image", "image_psnr_db"),
        ("masked", "chamfer_m2"), ("masked", "f_score"), ("masked", "range_rmse_m"),
        ("masked", "range_abs_error_median_m"), ("masked", "image_psnr_db"),
    ),
}  # fmt: skip
"""Split and region to the protocols and metrics whose means become metadata."""
_EXACT = (
    ("raw", "chamfer_m2"),
    ("raw", "f_score"),
    ("raw", "range_abs_error_median_m"),
    ("raw", "hit_accuracy"),
    ("image", "image_psnr_db"),
)
"""The same for views of the catalogue whose truth is known."""


@dataclass(slots=True)
class Ledger:
    """Rows of the metrics table, and the reasons of undefined values."""

    facts: dict[str, Any]
    """Columns that are the same for all rows: scene, commit, method and its cost."""
    rows: list[dict[str, Any]] = field(default_factory=list)
    undefined: Counter[str] = field(default_factory=Counter)
    """Reasons why values could not be computed, with counts."""
    absent: Counter[str] = field(default_factory=Counter)
    """Reasons why there was nothing to measure, with counts."""
    n_undefined_whole: int = 0
    """Number of values of whole held-out frames that could not be computed."""

    def add(
        self,
        measures: Mapping[str, Measure],
        *,
        split: str = HELD_OUT,
        protocol: str,
        region: str = "all",
        sensor: str,
        frame: int,
        render_seconds: float,
    ) -> None:
        """Add one row per metric.

        Args:
            measures: Metric to its value.
            split: `test`, or the name of a view.
            protocol: What was compared.
            region: `all`, `foreground` or `background`.
            sensor: `lidar`, or a camera's name.
            frame: Frame number.
            render_seconds: Time to render the scan or image.
        """
        for metric, measure in measures.items():
            if measure.reason:
                place = "" if region == "all" else f" {region}"
                reasons = self.absent if measure.is_absent else self.undefined
                reasons[f"{protocol}{place} {metric}: {measure.reason}"] += 1
                is_whole = (split, region) == (HELD_OUT, "all")
                self.n_undefined_whole += int(is_whole and not measure.is_absent)
            self.rows.append(
                {
                    **self.facts, "split": split, "protocol": protocol, "region": region,
                    "sensor": sensor, "frame": frame, "metric": metric, "value": measure.value,
                    "unit": UNITS[metric], "n_valid": measure.n_valid, "render_seconds": render_seconds,
                }
            )  # fmt: skip

    def take(self, other: "Ledger") -> None:
        """Append the content of another ledger."""
        self.rows += other.rows
        self.undefined += other.undefined
        self.absent += other.absent
        self.n_undefined_whole += other.n_undefined_whole

    def output(self) -> StageOutput:
        """Metadata (counts, reasons, headline means) and checks of all rows."""
        values = np.array([row["value"] for row in self.rows], dtype=np.float64)
        infinite = self._infinite_of_model()
        n_infinite, n_absent = int(np.isinf(values).sum()), self.absent.total()
        n_undefined = int(np.isnan(values).sum()) - n_absent
        detail = (
            f"{values.size} values, {n_undefined} undefined, {n_infinite} infinite, {n_absent} not measured"
        )
        reasons = _listing(self.undefined)
        explained = "; ".join(part for part in (detail, reasons, _listing(infinite)) if part)
        metadata: dict[str, Scalar] = {
            "rows": len(self.rows), "undefined": n_undefined, "infinite": n_infinite,
            "not_measured": n_absent, "undefined_reasons": reasons or "none",
            "not_measured_reasons": _listing(self.absent) or "none", "table": summary_table(self.rows),
        }  # fmt: skip
        metadata |= self._headlines()
        checks = [
            Check(name="some_frame_was_measured", passed=bool(self.rows), detail=detail),
            # Only whole held-out frames count: elsewhere an undefined value is a finding, no fault.
            DEFINED.outcome(float(self.n_undefined_whole + infinite.total()), 0.0, explained),
        ]
        return StageOutput(metadata=metadata, checks=checks)

    def _infinite_of_model(self) -> Counter[str]:
        """Infinite values of whole held-out frames, by name, with counts.

        Of a baseline they are a finding: a copy that leaves a tenth of the rays without an answer.
        """
        return Counter(
            f"{row['protocol']} {row['metric']}: infinite"
            for row in self.rows
            if (row["split"], row["region"]) == (HELD_OUT, "all")
            and row["recipe"] not in BASELINES
            and math.isinf(row["value"])
        )

    def _headlines(self) -> dict[str, Scalar]:
        shown: dict[str, Scalar] = {}
        for row in mean_rows(self.rows):
            is_view = row["split"] != HELD_OUT
            wanted = _HEADLINES.get((row["split"], row["region"]), ())
            if is_view:
                wanted = _EXACT if row["region"] == "all" else ()
            if (row["protocol"], row["metric"]) in wanted and not math.isnan(row["value"]):
                place = row["split"] if is_view else row["region"]
                key = f"{row['recipe']}/{row['protocol']}/{row['sensor']}/{row['metric']}"
                shown[key if place == "all" else f"{place}/{key}"] = float(row["value"])
        return shown


def method_columns(name: str, attrs: Mapping[str, Any], recipe: str, seed: int) -> dict[str, Any]:
    """Columns on the method and its cost, the same for all its rows; an unknown cost is NaN."""
    costs = ("train_seconds", "parameters", "model_mb", "peak_memory_mb")
    found = {cost: math.nan if attrs.get(cost) is None else float(attrs[cost]) for cost in costs}
    return {"recipe": recipe if name == "model" else name, "seed": seed, **found}


def _listing(reasons: Counter[str]) -> str:
    return "; ".join(f"{reason} ({n} times)" for reason, n in reasons.most_common())
