"""The columns of `scene_metrics`, means over its rows, and a table of them for the terminal."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

from nvsf_core.metrics.trust.cues import PROTOCOL
from nvsf_core.metrics.trust.cues import UNITS as TRUST_UNITS

COLUMNS = (
    "scene", "split", "frame", "protocol", "region", "sensor", "metric", "value", "unit", "n_valid", "recipe",
    "seed", "train_seconds", "render_seconds", "parameters", "model_mb", "peak_memory_mb", "commit",
)  # fmt: skip
"""Columns of `scene_metrics`, which has a row for each frame and metric."""

UNITS = {
    "chamfer_m2": "m2", "f_score": "1",
    "range_rmse_m": "m", "range_medae_m": "m", "range_psnr_db": "dB", "range_ssim": "1",
    "range_lpips_squeeze": "1", "range_lpips_alex": "1",
    "range_abs_error_median_m": "m", "range_abs_error_p90_m": "m", "range_missing": "1",
    "intensity_rmse": "1", "intensity_medae": "1", "intensity_psnr_db": "dB", "intensity_ssim": "1",
    "intensity_lpips_squeeze": "1", "intensity_lpips_alex": "1",
    "hit_rmse": "1", "hit_accuracy": "1", "hit_f_score": "1",
    "image_psnr_db": "dB", "image_ssim": "1", "image_lpips_squeeze": "1",
    "image_lpips_alex": "1", "image_depth_rmse_m": "m", "image_missing": "1", **TRUST_UNITS,
}  # fmt: skip
"""Unit of each metric; 1 = dimensionless."""

HELD_OUT = "test"
"""Name of the split of frames that are held out of training and scored."""
BASELINES = ("reproject", "copy_nearest", "mesh")
"""Recipes without learning, in the order of a table, which lists them below the models."""

_PANO = ("chamfer_m2", "f_score", "range_rmse_m", "range_psnr_db", "intensity_rmse", "hit_accuracy")
HEADLINES = {
    "lidar4d": _PANO,
    "lidar4d_scan": _PANO,
    "raw": (
        "chamfer_m2", "f_score", "range_abs_error_median_m", "range_missing",
        "intensity_rmse", "hit_accuracy",
    ),
    "masked": (
        "chamfer_m2", "f_score", "range_rmse_m", "range_abs_error_median_m", "range_missing",
        "intensity_rmse", "hit_accuracy", "image_psnr_db", "image_ssim",
    ),
    "image": (
        "image_psnr_db", "image_ssim", "image_lpips_squeeze", "image_depth_rmse_m", "image_missing",
    ),
    PROTOCOL: (),
}  # fmt: skip
"""Metrics of each protocol in the terminal's table; the store and the report have all."""

_SHORT = {
    "chamfer_m2": "CD m2", "f_score": "F", "range_rmse_m": "range RMSE m", "range_psnr_db": "range PSNR dB",
    "range_abs_error_median_m": "|range err| med m", "range_missing": "missing",
    "intensity_rmse": "intens. RMSE", "hit_accuracy": "hit acc.",
    "image_psnr_db": "PSNR dB", "image_ssim": "SSIM", "image_lpips_squeeze": "LPIPS-sq",
    "image_depth_rmse_m": "depth RMSE m", "image_missing": "missing",
}  # fmt: skip

Row = Mapping[str, Any]
Key = TypeVar("Key")


def mean_rows(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Mean over the frames of each scene, split, region, protocol, sensor, recipe, seed and metric.

    Returns:
        Rows with these keys, `value` (mean over the frames where it is defined, NaN if there is none),
        `unit`, `n_frames`, `n_defined`, `render_seconds` (mean a frame), and the model's `train_seconds`,
        `parameters` and `model_mb`.
    """
    keys = ("scene", "split", "region", "protocol", "sensor", "recipe", "seed", "metric")
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in keys), []).append(row)
    means = []
    for key, group in groups.items():
        value, n_defined = _mean([row["value"] for row in group])
        costs = {name: group[0][name] for name in ("unit", "train_seconds", "parameters", "model_mb")}
        seconds, _ = _mean([row["render_seconds"] for row in group])
        means.append(
            dict(zip(keys, key, strict=True))
            | costs
            | {"value": value, "n_frames": len(group), "n_defined": n_defined, "render_seconds": seconds}
        )
    return means


def over_most_frames(n_defined: Mapping[Key, int]) -> set[Key]:
    """Which of several means may be called the best: those over as many frames as any of them.

    A method that gives nothing in a hard frame has a mean over the others, easier ones.

    Args:
        n_defined: Name of each mean to the number of frames where it is defined.
    """
    most = max(n_defined.values(), default=0)
    return {name for name, count in n_defined.items() if count == most}


def summary_table(rows: Sequence[Row]) -> str:
    """A table in plain text, one block for each scene, split, protocol and sensor, models above baselines.

    The protocol `masked` is shown for the foreground only. `*` marks a mean over fewer frames than there are,
    `-` a metric that is undefined on all of them.
    """
    blocks: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for row in mean_rows(rows):
        shown = "foreground" if row["protocol"] == "masked" else "all"
        if row["region"] == shown and row["metric"] in HEADLINES[row["protocol"]]:
            key = (row["scene"], row["split"], row["protocol"], row["region"], row["sensor"])
            blocks.setdefault(key, []).append(row)
    # Rows are stored method by method; readers compare methods within a protocol.
    order = sorted(
        blocks, key=lambda key: (key[0], key[1] != HELD_OUT, key[1], list(HEADLINES).index(key[2]), key[4])
    )
    return "\n\n".join(_block(key, blocks[key]) for key in order)


def _block(key: tuple[str, ...], rows: Sequence[dict[str, Any]]) -> str:
    scene, split, protocol, region, sensor = key
    found = {row["metric"] for row in rows if row["n_defined"]} or {row["metric"] for row in rows}
    metrics = [metric for metric in HEADLINES[protocol] if metric in found]
    methods = sorted(
        {(row["recipe"], row["seed"]) for row in rows}, key=lambda method: (method_rank(method[0]), method)
    )
    lines = [["method", *(_SHORT[metric] for metric in metrics), "train s", "render s/frame"]]
    for recipe, seed in methods:
        mine = {row["metric"]: row for row in rows if (row["recipe"], row["seed"]) == (recipe, seed)}
        any_row = next(iter(mine.values()))
        costs = [_number(any_row["train_seconds"], 1), _number(any_row["render_seconds"], 3)]
        lines.append([recipe, *(_cell(mine.get(metric)) for metric in metrics), *costs])
    widths = [max(len(line[i]) for line in lines) for i in range(len(lines[0]))]
    n_frames = max(row["n_frames"] for row in rows)
    kind = "sweep" if sensor == "lidar" else "image"
    what = f"{n_frames} held-out frame(s)" if split == HELD_OUT else f"{n_frames} {kind}(s) of view {split}"
    place = "" if region == "all" else f"{region} | "
    text = [f"{scene} | protocol {protocol} | {sensor} | {place}mean of {what}"]
    for line in lines:
        cells = [line[0].ljust(widths[0])] + [c.rjust(w) for c, w in zip(line[1:], widths[1:], strict=True)]
        text.append("  " + "  ".join(cells))
    return "\n".join(text)


def method_rank(recipe: str) -> int:
    """Place of a method in tables: models first, then the baselines in their own order."""
    return 1 + BASELINES.index(recipe) if recipe in BASELINES else 0


def _cell(row: dict[str, Any] | None) -> str:
    if row is None or row["n_defined"] == 0:
        return "-"
    digits = 2 if row["unit"] == "dB" else 4
    return _number(row["value"], digits) + ("*" if row["n_defined"] < row["n_frames"] else "")


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None or math.isnan(value) else f"{value:.{digits}f}"


def _mean(values: Sequence[float | None]) -> tuple[float, int]:
    """Mean of the defined values and their number."""
    defined = [value for value in values if value is not None and not math.isnan(value)]
    return (sum(defined) / len(defined) if defined else math.nan), len(defined)
