"""The report's tables of methods, made from rows of mean metrics."""

import math
from collections.abc import Sequence
from typing import Any

from nvsf_core.metrics.table import HELD_OUT, method_rank
from nvsf_core.metrics.trust.cues import PROTOCOL
from nvsf_core.reporting.html import UNITS, Column, best_rows, higher_is_better, methods_table
from nvsf_core.reporting.scene_outputs import mean_of

HEADLINES = (
    ("lidar4d_scan", "chamfer_m2", "Chamfer"), ("lidar4d_scan", "f_score", "F-score"),
    ("lidar4d_scan", "range_psnr_db", "range PSNR"),
    ("raw", "range_abs_error_median_m", "range error, median"),
    ("raw", "range_missing", "no answer"), ("raw", "hit_accuracy", "hit accuracy"),
    ("raw", "intensity_rmse", "intensity RMSE"), ("image", "image_psnr_db", "PSNR"),
    ("image", "image_ssim", "SSIM"),
)  # fmt: skip
"""Protocol, metric and title of the main columns of every scene."""

_VIEW_IMAGES = ("image_psnr_db", "image_ssim", "image_lpips_squeeze", "image_missing")
"""Columns of `view_table`."""

PROTOCOLS = {
    "lidar4d": "as published by LiDAR4D: the recorded scan projected to a 66×1030 range image, against the"
    " range image that the model renders",
    "lidar4d_scan": "the same, but the prediction is the exported scan, projected in the same way",
    "raw": "the recorded scan itself, 0 to 80 m: errors along the recorded rays, hits on a grid of lasers ×"
    " 2000 azimuths (a half or a quarter where the sensor fires less often)",
    "masked": "inside and outside the boxes of moving objects",
    "image": "all pixels of the recorded camera image, or of a view's true image",
}
"""Description of each protocol."""

METHOD_WORDS = {
    "reproject": "baseline: the recorded returns of the other frames, rendered along the sensor's rays;"
    " nothing is learned",
    "copy_nearest": "baseline: the recorded scan and image nearest in time, as they are",
    "mesh": "baseline: what a library gives, a Poisson mesh of the other frames' returns, along whose surface"
    " the sensor's rays end and images are warped",
}

_METRIC_WORDS = {
    "chamfer_m2": "Chamfer", "f_score": "F-score", "range_rmse_m": "range RMSE", "range_medae_m": "range"
    " MedAE",
    "range_psnr_db": "range PSNR", "range_ssim": "range SSIM", "range_missing": "no answer",
    "range_abs_error_median_m": "range error, median", "range_abs_error_p90_m": "range error, p90",
    "intensity_rmse": "intensity RMSE", "intensity_medae": "intensity MedAE",
    "intensity_psnr_db": "intensity PSNR", "intensity_ssim": "intensity SSIM", "hit_rmse": "hit RMSE",
    "hit_accuracy": "hit accuracy", "hit_f_score": "hit F", "image_psnr_db": "PSNR", "image_ssim": "SSIM",
    "image_depth_rmse_m": "depth RMSE", "image_missing": "no answer",
    "image_lpips_squeeze": "LPIPS squeeze",
}  # fmt: skip

Row = dict[str, Any]


def methods_of(rows: Sequence[Row]) -> list[tuple[str, str, bool]]:
    """Name, description and whether it is trained, of each method in the rows: models first."""
    found = {row["method"]: row for row in rows}
    order = sorted(found.values(), key=lambda row: (method_rank(row["recipe"]), row["method"]))
    return [
        (row["method"], METHOD_WORDS.get(row["recipe"], "trained field"), not row["is_baseline"])
        for row in order
    ]


def headline_columns(rows: Sequence[Row]) -> list[Column]:
    """Columns of the main errors at the held-out frames, then of time and size."""
    methods = [name for name, _, _ in methods_of(rows)]
    by_method = {name: [row for row in rows if row["method"] == name] for name in methods}
    columns = []
    for protocol, metric, title in HEADLINES:
        column = _column(by_method, protocol, metric, title, protocol)
        if not all(math.isnan(value) for value in column.values):
            columns.append(column)
    costs = (
        ("train_seconds", "training", "s", None, 1), ("render_seconds", "a scan", "s", "lidar", 2),
        ("render_seconds", "an image", "s", "image", 2), ("parameters", "parameters", "", None, 0),
        ("model_mb", "model", "MB", None, 1),
    )  # fmt: skip
    for key, title, unit, kind, digits in costs:
        values = [_cost(by_method[name], key, kind) for name in methods]
        if not all(math.isnan(value) for value in values):
            columns.append(
                Column(
                    group="time and size", title=title, unit=unit, higher_is_better=None, values=values,
                    notes=[""] * len(values), digits=digits,
                )
            )  # fmt: skip
    return columns


def full_tables(rows: Sequence[Row]) -> list[tuple[str, str]]:
    """Heading and HTML table for each measured split, protocol, region and sensor.

    The protocol `trust`, which measures nothing, has a section of its own.
    """
    rows = [row for row in rows if row["protocol"] != PROTOCOL]
    keys = sorted(
        {(row["split"], row["protocol"], row["region"], row["sensor"]) for row in rows},
        key=lambda key: (key[0] != HELD_OUT, *key),
    )
    tables = []
    for key in keys:
        mine = [row for row in rows if (row["split"], row["protocol"], row["region"], row["sensor"]) == key]
        methods = [name for name, _, _ in methods_of(mine)]
        metrics = list(dict.fromkeys(row["metric"] for row in mine))
        columns = []
        for metric in metrics:
            cells = [
                [row for row in mine if (row["method"], row["metric"]) == (name, metric)] for name in methods
            ]
            found = [
                (cell[0]["value"], cell[0]["n_defined"], cell[0]["n_frames"]) if cell else (math.nan, 0, 0)
                for cell in cells
            ]
            unit = next(cell[0]["unit"] for cell in cells if cell)
            columns.append(_metric_column(key[1], metric, _METRIC_WORDS.get(metric, metric), unit, found))
        split, protocol, region, sensor = key
        frames = max(row["n_frames"] for row in mine)
        where = "held-out frames" if split == HELD_OUT else f"split {split}"
        place = "" if region == "all" else f", {region}"
        heading = f"{where}, protocol {protocol}, {sensor}{place}: mean of {frames} frames"
        tables.append((heading, methods_table(methods_of(mine), columns)))
    return tables


def image_scores(rows: Sequence[Row], view: str, camera: str) -> dict[str, float]:
    """Recipe or baseline to the mean PSNR in dB of a view's images by one camera; of the newest run."""
    wanted = (view, "image", "all", camera, "image_psnr_db")
    keys = ("split", "protocol", "region", "sensor", "metric")
    found: dict[str, float] = {}
    for row in rows:
        if tuple(row[key] for key in keys) == wanted and not math.isnan(row["value"]):
            found.setdefault(row["recipe"], row["value"])
    return found


def view_table(rows: Sequence[Row], view: str) -> str:
    """HTML table of the errors of a view's images, mean over its cameras; empty if none were measured."""
    mine = [row for row in rows if (row["split"], row["protocol"]) == (view, "image")]
    by_method = {name: [row for row in mine if row["method"] == name] for name, _, _ in methods_of(mine)}
    columns = [
        _column(by_method, "image", metric, _METRIC_WORDS.get(metric, metric), "images of this view", view)
        for metric in _VIEW_IMAGES
    ]
    shown = [column for column in columns if not all(math.isnan(value) for value in column.values)]
    return methods_table(methods_of(mine), shown) if shown else ""


def wins(rows: Sequence[Row]) -> dict[str, int]:
    """Number of headline errors in which each recipe and baseline is best.

    One in which a model and a baseline are level to the last digit counts for neither. Of a recipe with
    several seeds the mean over them counts: the best of them is partly luck.
    """
    methods = methods_of(over_seeds(rows))
    count = dict.fromkeys((name for name, _, _ in methods), 0)
    for best in _exactly_best(rows):
        if len({methods[row][2] for row in best}) == 1:
            for row in best:
                count[methods[row][0]] += 1
    return count


def level_with(rows: Sequence[Row], recipe: str) -> dict[str, int]:
    """Baseline to the number of headline errors in which it and a recipe are the best, to the last digit."""
    methods = methods_of(over_seeds(rows))
    mine = next(row for row, (name, _, _) in enumerate(methods) if name == recipe)
    count: dict[str, int] = {}
    for best in _exactly_best(rows):
        for name, _, is_model in (methods[row] for row in best if mine in best):
            if not is_model:
                count[name] = count.get(name, 0) + 1
    return count


def _exactly_best(rows: Sequence[Row]) -> list[list[int]]:
    """Of each headline error the rows of its best value; one that is shown alike may still be worse."""
    found = []
    for column in headline_columns(over_seeds(rows)):
        shown = best_rows(column)
        value = (max if column.higher_is_better else min)((column.values[row] for row in shown), default=0.0)
        found.append([row for row in sorted(shown) if column.values[row] == value])
    return found


def over_seeds(rows: Sequence[Row]) -> list[Row]:
    """Rows of recipes instead of runs: means over their seeds."""
    keys = ("split", "protocol", "region", "sensor", "metric", "recipe")
    seeds: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        seeds.setdefault(tuple(row[key] for key in keys), []).append(row)
    return [_mean_of_seeds(of_recipe) for of_recipe in seeds.values()]


def _mean_of_seeds(rows: Sequence[Row]) -> Row:
    """One number of a recipe; it is over the frames of the seed that has fewest."""
    value = sum(row["value"] for row in rows) / len(rows)
    fewest = min(row["n_defined"] for row in rows)
    return {**rows[0], "method": rows[0]["recipe"], "value": value, "n_defined": fewest}


def _column(
    by_method: dict[str, list[Row]], protocol: str, metric: str, title: str, group: str, split: str = HELD_OUT
) -> Column:
    found = [mean_of(rows, protocol, metric, split) for rows in by_method.values()]
    units = [row["unit"] for rows in by_method.values() for row in rows if row["metric"] == metric]
    unit = units[0] if units else ""
    return _metric_column(group, metric, title, unit, found)


def _metric_column(
    group: str, metric: str, title: str, unit: str, found: Sequence[tuple[float, int, int]]
) -> Column:
    """A column of means.

    Args:
        group: Heading above it and its neighbours.
        metric: Name of the metric.
        title: Words for it.
        unit: As it is stored.
        found: Of each method the mean, the frames where it is defined, and all frames.
    """
    digits = 2 if unit == "dB" else 4 if unit == "m2" else 3
    partial = "defined on {} of {} frames"
    return Column(
        group=group, title=title, unit=UNITS.get(unit, unit), higher_is_better=higher_is_better(metric),
        values=[value for value, _, _ in found], n_defined=[defined for _, defined, _ in found],
        notes=["" if n == frames else partial.format(n, frames) for _, n, frames in found], digits=digits,
    )  # fmt: skip


def _cost(rows: Sequence[Row], key: str, kind: str | None) -> float:
    """Mean of a cost over a method's held-out rows; `kind` is `lidar`, `image` or None for both."""
    values = [
        float(row[key])
        for row in rows
        if row["split"] == HELD_OUT and (kind is None or (row["sensor"] != "lidar") == (kind == "image"))
        if row[key] is not None and not math.isnan(row[key])
    ]
    return sum(values) / len(values) if values else math.nan
