"""Checks of the metrics table: values are possible, the model beats a copy, scans are like the recorded."""

import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nvsf_core.metrics.norms import intensity_spread, spread_distance
from nvsf_core.metrics.table import BASELINES, HEADLINES, HELD_OUT, Row, mean_rows
from nvsf_core.metrics.trust.verdict import Trust, verdicts
from nvsf_core.reporting.html import higher_is_better
from nvsf_core.stages.checks.declared import BETTER, HELD_OUT_HIT_RATE, HELD_OUT_INTENSITY, IN_RANGE, TRUSTED
from nvsf_core.stages.checks.norms import (
    NO_NORMS,
    Apart,
    check_likeness,
    read_norms,
)
from nvsf_core.stages.runner.stage import Check, Task
from nvsf_core.stages.scoring.lidar import part
from nvsf_core.stores.arrays import read_arrays, read_attrs
from nvsf_core.stores.tables import read_rows

TABLE_NAME = "metrics.parquet"

_HALF = 0.5
_NAMED = 5
_COPY = "copy_nearest"
_SHARES = ("f_score", "range_missing", "hit_accuracy", "hit_f_score", "hit_rmse", "image_missing")
_LIKENESS = ("range_ssim", "intensity_ssim", "image_ssim")


def check_metrics(task: Task) -> list[Check]:
    """Check the table in the task's folder, and the stored held-out scans against the recorded ones."""
    rows = read_rows(task.folder / TABLE_NAME)
    recipe, seed = task.config.recipe.name, task.config.seed
    view = task.store.require(f"novel_views/{recipe}/{seed}") / HELD_OUT / "model.zarr"
    return [_in_range(rows), _better(rows), *_as_recorded(task, view), _trusted(rows)]


def _in_range(rows: Sequence[Row]) -> Check:
    wrong = [row for row in rows if not _is_possible(row["metric"], float(row["value"]))]
    named = ", ".join(
        f"{row['metric']} {row['value']:.4g} ({row['recipe']}, {row['split']} frame {row['frame']})"
        for row in wrong[:_NAMED]
    )
    detail = f"{len(wrong)} of {len(rows)} values lie outside" + (f": {named}" if named else "")
    return IN_RANGE.outcome(float(len(wrong)), 0.0, detail)


def _is_possible(metric: str, value: float) -> bool:
    """Whether a metric can have the value; undefined values (NaN) are counted elsewhere."""
    if math.isnan(value) or metric.endswith("_db"):
        return True  # decibels are unbounded, and infinite for equal images
    slack = 1e-6  # rounding of float32 sums
    if metric in _LIKENESS:
        return -1.0 - slack <= value <= 1.0 + slack
    return -slack <= value <= (1.0 + slack if metric in _SHARES else math.inf)


def _better(rows: Sequence[Row]) -> Check:
    """Check `BETTER`: the share of each sensor's main numbers in which the model is worse than the copy.

    Scans have more numbers than images: over all of them together, a camera could fail unseen. Where one
    gives nothing in a frame that the other is measured in, it is the worse one, whatever its mean.
    """
    means = [
        row for row in mean_rows(rows)
        if (row["split"], row["region"]) == (HELD_OUT, "all")
        and row["metric"] in HEADLINES[row["protocol"]]
    ]  # fmt: skip
    key = ("protocol", "sensor", "metric")
    copied = {tuple(row[k] for k in key): row for row in means if row["recipe"] == _COPY}
    compared = [(tuple(row[k] for k in key), row) for row in means if row["recipe"] not in BASELINES]
    compared = [
        (number, row) for number, row in compared
        if number in copied and max(row["n_defined"], copied[number]["n_defined"]) > 0
    ]  # fmt: skip
    if not compared:
        return BETTER.not_run("no number of both the model and a copy of the nearest recording")
    worse = [number for number, row in compared if _is_worse(row, copied[number])]
    named = ", ".join(" ".join(number) for number in worse[:_NAMED])
    detail = f"worse in {len(worse)} of {len(compared)} main numbers" + (f": {named}" if named else "")
    n_compared = Counter(sensor for (_, sensor, _), _ in compared)
    n_worse = Counter(sensor for _, sensor, _ in worse)
    shares = {sensor: n_worse[sensor] / count for sensor, count in n_compared.items()}
    bad = [sensor for sensor, share in shares.items() if share > _HALF]
    if bad:
        detail += "; in most of " + ", ".join(
            f"{sensor}'s ({n_worse[sensor]} of {n_compared[sensor]})" for sensor in bad
        )
    return BETTER.outcome(max(shares.values()), _HALF, detail)


def _is_worse(row: Row, other: Row) -> bool:
    if row["n_defined"] != other["n_defined"]:
        return bool(row["n_defined"] < other["n_defined"])
    lower, higher = (row, other) if higher_is_better(row["metric"]) else (other, row)
    return bool(lower["value"] < higher["value"])


def _trusted(rows: Sequence[Row]) -> Check:
    said = [one for one in verdicts(mean_rows(rows)) if one.trust is not Trust.NOT_KNOWN]
    if not said:
        return TRUSTED.not_run("no view could be compared with recorded data that were left out")
    bad = [one for one in said if one.trust is Trust.DO_NOT_USE]
    named = "; ".join(f"{one.view}, {one.sensor}: {one.why}" for one in bad[:_NAMED])
    detail = f"{len(bad)} of {len(said)} must not be used" + (f": {named}" if named else "")
    return TRUSTED.outcome(float(len(bad)), 0.0, detail)


def _as_recorded(task: Task, view: Path) -> list[Check]:
    norms = read_norms(task.store)
    if norms is None or not view.is_dir() or not read_attrs(view).get("sensor"):
        reason = NO_NORMS if norms is None else "no held-out scan was rendered"
        return [HELD_OUT_HIT_RATE.not_run(reason), HELD_OUT_INTENSITY.not_run(reason)]
    recorded = read_arrays(
        task.store.require("sweeps") / "returns.zarr", "frame", "offsets", "firings", "intensity"
    )
    rendered = read_arrays(view, "frame", "offsets", "intensity")
    rates, spreads = Apart(), Apart()
    for i, frame in enumerate(rendered["frame"].tolist()):
        own = rendered["intensity"][part(rendered["offsets"], i)]
        for k in np.flatnonzero(recorded["frame"] == frame)[:1].tolist():
            truth = recorded["intensity"][part(recorded["offsets"], k)]
            rays = norms.lasers * int(recorded["firings"][k])
            if rays > 0:
                rates.append(((len(own) - len(truth)) / rays, f"frame {frame}"))
            if len(own) and len(truth) and np.isfinite(own).all():
                apart = spread_distance(intensity_spread(own), intensity_spread(truth))
                spreads.append((apart, f"frame {frame}"))
    return check_likeness(HELD_OUT_HIT_RATE, HELD_OUT_INTENSITY, rates, spreads, norms)
