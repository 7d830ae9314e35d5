"""Whether the trust score, made without truth, ranks views as their true errors do.

``SCENES="street kitti0005_van_cyclist" python -m benchmarks.views.trust`` reads the metrics that a run of
RECIPE (default: quick) left below NVSF_HOME, prints rank correlations (Spearman) of score and true error over
the views and the table of errors by support, and writes both into docs/trust.md. It measures nothing itself.
"""

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import spearmanr

from benchmarks.common.documents import markdown_table, write_between
from benchmarks.tables.measured import commits_of
from nvsf_core.drives.catalogue import home_from_environment
from nvsf_core.metrics.support_pool import pool_by_support
from nvsf_core.metrics.table import HELD_OUT, Row, mean_rows
from nvsf_core.metrics.trust.verdict import LIDAR, Trust, Verdict, verdicts
from nvsf_core.rendering.rendered import Support
from nvsf_core.stores.tables import read_rows

_SCENES = "street kitti0005_van_cyclist"
PAGE = Path(__file__).resolve().parents[2] / "docs" / "trust.md"
ERRORS = {
    "scans": (("raw", "f_score"), ("raw", "hit_accuracy"), ("raw", "chamfer_m2")),
    "images": (("image", "image_psnr_db"), ("image", "image_lpips_squeeze")),
}
"""Protocol and metric of what truth says."""
HEADS = {
    "f_score": "F", "hit_accuracy": "hit acc.", "chamfer_m2": "CD m²", "image_psnr_db": "PSNR dB",
    "image_lpips_squeeze": "LPIPS",
}  # fmt: skip
_RISES = ("f_score", "hit_accuracy", "image_psnr_db")
"""Metrics that are better the larger they are."""
_BY_SUPPORT = (("raw", "f_score"), ("raw", "hit_accuracy"), ("image", "image_psnr_db"))


@dataclass(frozen=True, slots=True)
class ScoredView:
    """A view's scans, or its images by one or all cameras: what is said of them, and what truth says."""

    scene: str
    view: str
    sensor: str
    words: str
    """The verdict; of a baseline's view its name."""
    score: float
    errors: Mapping[str, float]
    """Metric to its true value, means over frames and cameras; empty if nobody knows the truth."""


def main() -> None:
    """Print the tables, and write them into the page."""
    home, recipe = home_from_environment(os.environ), os.environ.get("RECIPE") or "quick"
    scenes = (os.environ.get("SCENES") or _SCENES).split()
    rows = [
        row
        for scene in scenes
        for row in read_rows(home / scene / "scene_metrics" / recipe / "0" / "metrics.parquet")
        if row["recipe"] == recipe
    ]
    for name, text in (
        ("orders", orders(rows, f"Recipe `{recipe}`, seed 0, commit {commits_of(rows)}.")),
        ("support", support_table(rows)),
    ):
        print(text)
        write_between(PAGE, name, text)


def orders(rows: Sequence[Row], source: str) -> str:
    """Tables of views with score and true error, and of their rank correlations."""
    parts = [source, ""]
    for kind, metrics in ERRORS.items():
        views = sorted(_views(rows, kind, by_camera=False), key=lambda one: one.score)
        head = ["scene", "view", "verdict", "score", *(HEADS[metric] for _, metric in metrics)]
        cells = [
            [one.scene, one.view, one.words, f"{one.score:.4f}", *_shown(one.errors, metrics)]
            for one in views
        ]
        parts += [f"**{kind.capitalize()}**, by their score:", "", markdown_table(head, cells)]
    head = ["what is ordered", "number", "true error", "rank correlation"]
    return "\n".join([*parts, markdown_table(head, _correlations(rows))])


def rank_correlation(views: Sequence[ScoredView], metric: str) -> tuple[int, float]:
    """How many views have both a score and that error, and Spearman's correlation; NaN below three views.

    It is 1 if a larger score always goes with a worse error.
    """
    sign = -1.0 if metric in _RISES else 1.0
    pairs = [(one.score, sign * one.errors.get(metric, math.nan)) for one in views]
    known = np.array([pair for pair in pairs if np.isfinite(pair).all()]).reshape(-1, 2)
    if len(known) < 3:
        return len(known), math.nan
    return len(known), float(spearmanr(known[:, 0], known[:, 1])[0])


def support_table(rows: Sequence[Row]) -> str:
    """Errors by support of all views whose truth is known, pooled over views, frames and cameras."""
    cells = []
    for scene in dict.fromkeys(row["scene"] for row in rows):
        for protocol, metric in _BY_SUPPORT:
            own = [row for row in rows if row["scene"] == scene]
            found = pool_by_support(own, protocol, metric).values()
            total = sum(one.n_valid for one in found)
            if total:
                shares = [f"{_number(one.value, metric)} ({one.n_valid / total:.1%})" for one in found]
                cells.append([scene, "scans" if protocol == "raw" else "images", HEADS[metric], *shares])
    head = ["scene", "of", "metric", *(support.name.lower() for support in reversed(Support))]
    return markdown_table(head, cells)


def _views(rows: Sequence[Row], kind: str, *, by_camera: bool) -> Iterator[ScoredView]:
    """Verdicts beside true errors; of images one for all cameras of a view, or one for each."""
    metrics = [metric for _, metric in ERRORS[kind]]
    for scene in dict.fromkeys(row["scene"] for row in rows):
        means = mean_rows([row for row in rows if row["scene"] == scene])
        said = [one for one in verdicts(means) if (one.sensor == LIDAR) == (kind == "scans")]
        true = {
            (row["split"], row["sensor"], row["metric"]): row["value"] for row in means
            if row["region"] == "all" and (row["protocol"], row["metric"]) in ERRORS[kind]
        }  # fmt: skip
        groups = dict.fromkeys((one.view, one.sensor if by_camera else "") for one in said)
        for view, sensor in groups:
            mine = [one for one in said if one.view == view and sensor in ("", one.sensor)]
            errors = {
                metric: float(np.mean([true.get((view, one.sensor, metric), math.nan) for one in mine]))
                for metric in metrics
            }
            score = float(np.mean([one.score for one in mine]))
            yield ScoredView(scene, view, sensor or kind, _words(mine), score, errors)


def _words(said: Sequence[Verdict]) -> str:
    """The worst verdict of several."""
    return max((one.trust for one in said), default=Trust.NOT_KNOWN).words


def _correlations(rows: Sequence[Row]) -> Iterator[tuple[str, int, str, str]]:
    """Rank correlations over views, without and with the held-out frames, and over views and cameras."""
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    for kind, metrics in ERRORS.items():
        views = list(_views(rows, kind, by_camera=False))
        each = list(_views(rows, kind, by_camera=True))
        sets = [
            (f"{kind}: views asked for, {scenes[0]}", [v for v in views if v.scene == scenes[0]]),
            (f"{kind}: views asked for, all scenes", views),
        ]
        sets = [(words, [v for v in some if v.view != HELD_OUT]) for words, some in sets]
        sets.append((f"{kind}: these and the held-out frames", views))
        if kind == "images":
            sets.append(("images: each camera of these views by itself", each))
        for words, some in sets:
            for _, metric in metrics:
                count, rho = rank_correlation(some, metric)
                yield words, count, HEADS[metric], "–" if math.isnan(rho) else f"{rho:.2f}"


def _shown(errors: Mapping[str, float], metrics: Sequence[tuple[str, str]]) -> list[str]:
    return [_number(errors[metric], metric) for _, metric in metrics]


def _number(value: float, metric: str) -> str:
    if math.isnan(value):
        return "–"
    return f"{value:.1f}" if metric.endswith("_db") else f"{value:.3f}"


if __name__ == "__main__":
    main()
