"""What a run gained, in a sentence and a small table for the terminal: a model beside the best baseline."""

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from nvsf_core.metrics.table import BASELINES, HELD_OUT, mean_rows

_SHOWN = (
    # protocol, metric, heading, digits, whether higher is better
    ("lidar4d_scan", "chamfer_m2", "CD m2", 4, False),
    ("lidar4d_scan", "f_score", "F", 4, True),
    ("lidar4d_scan", "range_psnr_db", "range dB", 2, True),
    ("lidar4d_scan", "hit_accuracy", "hits", 4, True),
    ("image", "image_psnr_db", "image dB", 2, True),
    ("image", "image_lpips_squeeze", "LPIPS", 3, False),
)
"""Few enough for 80 columns; all others stand in the report."""
_MOST_VIEWS = 4
_LEGEND = "CD, LPIPS: lower is better; others: higher. Mean of the held-out frames;"
_PARTIAL = "* over fewer of them than there are, - over none."


def headline(rows: Sequence[Mapping[str, Any]]) -> str:
    """One scene's result in at most fourteen lines of 80 columns.

    Args:
        rows: Rows of `scene_metrics`, of one scene.

    Returns:
        Where the model beats the best baseline and where a baseline beats it, images off the recorded path
        where their truth is known, then the table; empty where nothing was measured on held-out frames.
    """
    values, partial = _values(rows)
    models = [method for method in values if method not in BASELINES]
    if not models:
        return ""
    scene, model = rows[0]["scene"], models[0]
    won: list[str] = []
    lost: dict[str, list[str]] = {}
    for _, metric, heading, _, higher in _SHOWN:
        sign, word = (1.0 if higher else -1.0), heading.split()[0]
        mine = sign * values[model].get(metric, math.nan)
        others = {
            name: sign * value[metric] for name, value in values.items() if name != model and metric in value
        }
        others = {name: value for name, value in others.items() if not math.isnan(value)}
        if math.isnan(mine) or not others:
            continue
        best = max(others, key=lambda name: others[name])
        if mine > others[best]:
            won.append(word)
        elif mine < others[best]:
            lost.setdefault(best, []).append(word)
    lines = [f"{scene}: {model} beats every baseline in {', '.join(won) or 'nothing'}"]
    lines += [f"  {name} is better in {', '.join(words)}" for name, words in lost.items()]
    return "\n".join([*lines, *_off_path(rows, model), *_table(values, partial, model)])


def _off_path(rows: Sequence[Mapping[str, Any]], model: str) -> list[str]:
    """Image PSNR of each view whose truth is known, at most four views, beside the best baseline's."""
    found: dict[str, dict[str, list[float]]] = {}
    for row in mean_rows(rows):
        is_image = (row["protocol"], row["metric"], row["region"]) == ("image", "image_psnr_db", "all")
        if is_image and row["split"] != HELD_OUT and not math.isnan(row["value"]):
            found.setdefault(row["split"], {}).setdefault(row["recipe"], []).append(row["value"])
    lines = []
    for view, values in found.items():
        means = {name: sum(one) / len(one) for name, one in values.items()}
        others = [name for name in means if name != model]
        if model in means and others:
            best = max(others, key=lambda name: means[name])
            lines.append(
                f"  view {view}: images {means[model]:.1f} dB, the best baseline {means[best]:.1f} ({best})"
            )
    return lines[:_MOST_VIEWS]


def _values(
    rows: Sequence[Mapping[str, Any]],
) -> tuple[dict[str, dict[str, float]], set[tuple[str, str]]]:
    """Mean of each shown metric by method, over all cameras; and which are undefined on some frames."""
    found: dict[str, dict[str, list[float]]] = {}
    partial = set()
    shown = {(protocol, metric) for protocol, metric, *_ in _SHOWN}
    for row in mean_rows(rows):
        if (row["protocol"], row["metric"]) in shown and (row["split"], row["region"]) == (HELD_OUT, "all"):
            found.setdefault(row["recipe"], {}).setdefault(row["metric"], []).append(row["value"])
            if row["n_defined"] < row["n_frames"]:
                partial.add((row["recipe"], row["metric"]))
    means = {
        method: {metric: sum(values) / len(values) for metric, values in metrics.items()}
        for method, metrics in found.items()
    }
    return means, partial


def _table(
    values: Mapping[str, Mapping[str, float]], partial: Collection[tuple[str, str]], model: str
) -> list[str]:
    methods = [model, *(name for name in BASELINES if name in values)]
    shown = [row for row in _SHOWN if any(row[1] in values[name] for name in methods)]
    lines = ["  " + "".join([f"{'':14}", *(f"{heading:>9} " for _, _, heading, *_ in shown)])]
    for name in methods:
        cells = [
            f"{values[name][metric]:9.{digits}f}{'*' if (name, metric) in partial else ' '}"
            if not math.isnan(values[name].get(metric, math.nan))
            else f"{'-':>9} "
            for _, metric, _, digits, _ in shown
        ]
        lines.append("  " + "".join([f"{name:14}", *cells]))
    return [*(line.rstrip() for line in lines), f"  {_LEGEND}", f"  {_PARTIAL}"]
