"""Error over training time, read from the JSON files of `make bench`, as curves and table cells.

A JSON file is one run: `run` says what was trained, on which scene and machine; `points` are rows of recipe,
scene, seed, mark (requested seconds; null = end of training), seconds (actual), metric, value.
"""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

from nvsf_core.metrics.table import BASELINES

Run = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Metric:
    """A metric of the curves and tables."""

    key: str
    title: str
    digits: int
    higher_is_better: bool = False


METRICS = (
    Metric("chamfer_m2", "CD [m²]", 3),
    Metric("range_psnr_db", "range PSNR [dB]", 2, higher_is_better=True),
    Metric("range_abs_error_median_m", "raw median range error [m]", 3),
    Metric("image_psnr_db", "camera PSNR [dB]", 2, higher_is_better=True),
)
"""Each has one panel and one table."""

COSTS = (
    ("train_seconds", "training s", 0), ("parameters", "parameters", 0), ("model_mb", "model MB", 1),
    ("peak_memory_mb", "memory MB", 0), ("samples_a_ray", "samples a ray", 1),
    ("rays_per_s", "rays/s in training", 0), ("sweep_seconds", "a sweep s", 2),
    ("image_seconds", "an image s", 2),
)  # fmt: skip
"""Key in `run`, column title and decimal digits."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Point:
    """Mean of one recipe at one time, over its seeds."""

    mark_s: float | None
    """Requested seconds; None = end of training."""
    seconds: float
    value: float
    spread: float | None
    """Standard deviation; None for one seed, or if a value is not finite."""
    seeds: int


def read_runs(folder: Path) -> list[Run]:
    """All runs below a folder of results, in the order of their paths."""
    return [json.loads(path.read_text()) for path in sorted(folder.glob("*/*/*.json"))]


def groups(runs: Iterable[Run]) -> dict[tuple[str, str], list[Run]]:
    """Scene and split to their runs, in the order of the runs."""
    found: dict[tuple[str, str], list[Run]] = {}
    for run in runs:
        found.setdefault((run["run"]["scene"], run["run"]["split"]), []).append(run)
    return found


def recipes_of(runs: Sequence[Run]) -> list[str]:
    """Trained recipes by name, then the baselines in their own order."""
    names = {run["run"]["recipe"] for run in runs}
    return sorted(names - set(BASELINES)) + [name for name in BASELINES if name in names]


def final_values(run: Run) -> dict[str, float]:
    """Metric to its value at the end of training."""
    return {point["metric"]: point["value"] for point in run["points"] if point["mark"] is None}


def curve(runs: Sequence[Run], recipe: str, metric: str) -> list[Point]:
    """Points of one recipe and metric, in the order of time."""
    rows: dict[float | None, list[Mapping[str, Any]]] = {}
    for run in runs:
        for point in run["points"]:
            if (point["recipe"], point["metric"]) == (recipe, metric):
                rows.setdefault(point["mark"], []).append(point)
    points = [
        Point(
            mark_s=mark,
            seconds=fmean(row["seconds"] for row in mine),
            value=fmean(row["value"] for row in mine),
            spread=_spread([row["value"] for row in mine]),
            seeds=len(mine),
        )
        for mark, mine in rows.items()
    ]
    return sorted(points, key=lambda point: point.seconds)


def pareto_front(curves: Mapping[str, Sequence[Point]], metric: Metric) -> list[tuple[str, Point]]:
    """Points that are better than every faster point, with their recipes, in the order of time."""
    everything = [(name, point) for name, points in curves.items() for point in points]
    sign = -1.0 if metric.higher_is_better else 1.0
    front, best = [], math.inf
    for name, point in sorted(everything, key=lambda item: (item[1].seconds, sign * item[1].value)):
        if sign * point.value < best:
            best = sign * point.value
            front.append((name, point))
    return front


def labelled(runs: Sequence[Run], metric: Metric) -> tuple[list[float], list[tuple[str, list[str]]]]:
    """A metric's table: the marks in seconds, then per recipe one cell per mark and one for the end.

    A cell is the mean and, for several seeds, the standard deviation. `**` around it: on the Pareto front.
    An em dash: there was no model yet, or training had ended.
    """
    curves = {name: curve(runs, name, metric.key) for name in recipes_of(runs)}
    front = {id(point) for _, point in pareto_front(curves, metric)}
    marks = sorted({p.mark_s for points in curves.values() for p in points if p.mark_s is not None})
    rows = []
    for name, points in curves.items():
        by_mark = {point.mark_s: point for point in points}
        found = [by_mark.get(mark) for mark in (*marks, None)]
        cells = ["—" if p is None else _cell(p, metric.digits, p.mark_s is None) for p in found]
        bold = [p is not None and id(p) in front for p in found]
        rows.append((name, [f"**{c}**" if b else c for c, b in zip(cells, bold, strict=True)]))
    return marks, [row for row in rows if any(cell != "—" for cell in row[1])]


def cost_rows(runs: Sequence[Run]) -> list[list[str]]:
    """Printed rows of recipe, number of seeds, and mean of each of `COSTS`."""
    rows = []
    for name in recipes_of(runs):
        facts = [run["run"] for run in runs if run["run"]["recipe"] == name]
        seeds = "" if name in BASELINES else str(len(facts))
        known = [[f[key] for f in facts if f.get(key) is not None] for key, _, _ in COSTS]
        cells = [
            f"{fmean(values):,.{digits}f}" if values else "—"
            for values, (_, _, digits) in zip(known, COSTS, strict=True)
        ]
        rows.append([name, seeds, *cells])
    return rows


def provenance(runs: Sequence[Run]) -> str:
    """One sentence on scene, split, protocol, seeds, machine and commit of runs of one scene."""
    facts = [run["run"] for run in runs]
    first = facts[0]
    seeds = sorted({str(f["seed"]) for f in facts if f["recipe"] not in BASELINES})
    machines, commits = (sorted({f[key] for f in facts}) for key in ("machine", "commit"))
    frames = {f["split"]: f"{f['split']} ({len(f['trained'])} frames trained, {len(f['scored'])} scored)"
              for f in facts}  # fmt: skip
    return (
        f"Scene {first['scene']}, split {', '.join(frames.values())}. Protocol {first['protocol']}. "
        f"Seeds {', '.join(seeds) or 'none'}. "
        f"Machine: {'; '.join(machines)}. Commit {', '.join(commits)}."
    )


def _spread(values: Sequence[float]) -> float | None:
    return stdev(values) if len(values) > 1 and all(map(math.isfinite, values)) else None


def _cell(point: Point, digits: int, is_end: bool) -> str:
    if not math.isfinite(point.value):
        return "undefined" if math.isnan(point.value) else "infinite"
    spread = "" if point.spread is None else f" ± {point.spread:.{digits}f}"
    when = f" ({point.seconds:.0f} s)" if is_end else ""
    return f"{point.value:.{digits}f}{spread}{when}"
