"""What a run gained, in a sentence and a small table for the terminal: a model beside the best baseline."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from nvsf_core.metrics.table import BASELINES, HELD_OUT, mean_rows, over_most_frames

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
LEAST_LEVEL = 2
"""Numbers in which a model is level with a baseline, to the last digit, from which on it shows the same: one
may be level by chance, as where both are perfect."""
_LEGEND = "CD, LPIPS: lower is better; others: higher. Mean of the held-out frames;"
_PARTIAL = "* over fewer of them than there are, - over none."


class _Mean(NamedTuple):
    """Mean of one metric of one method, over all cameras."""

    value: float
    n_defined: int
    """Frames, of all cameras together, that it is over."""
    is_partial: bool
    """Whether it is undefined on some of them."""


def headline(rows: Sequence[Mapping[str, Any]]) -> str:
    """One scene's result in some fourteen lines of 80 columns.

    Returns:
        Where the model beats the best baseline, where it is level with it and where a baseline beats it,
        images off the recorded path where their truth is known, then the table; empty where nothing was
        measured on held-out frames. A mean over fewer frames than another beats none.
    """
    means = _means(rows)
    models = [method for method in means if method not in BASELINES]
    if not models:
        return ""
    scene, model = rows[0]["scene"], models[0]
    won: list[str] = []
    level: dict[str, list[str]] = {}
    lost: dict[str, list[str]] = {}
    for _, metric, heading, _, higher in _SHOWN:
        sign, word = (1.0 if higher else -1.0), heading.split()[0]
        measured = {name: of[metric] for name, of in means.items() if metric in of}
        measured = {name: mean for name, mean in measured.items() if not math.isnan(mean.value)}
        if metric not in means[model] or not measured.keys() - {model}:
            continue
        whole = over_most_frames({name: mean.n_defined for name, mean in measured.items()})
        # What is measured of the baselines alone, the model gave in no frame.
        mine = sign * measured[model].value if model in measured else -math.inf
        others = {name: sign * measured[name].value for name in measured if name in whole - {model}}
        best = max(others, key=lambda name: others[name], default=None)
        if best is not None and mine < others[best]:
            lost.setdefault(best, []).append(word)
        elif model in whole and (best is None or mine > others[best]):
            won.append(word)
        elif model in whole and best is not None:
            level.setdefault(best, []).append(word)
    lines = [f"{scene}: {model} beats every baseline in {', '.join(won) or 'nothing'}"]
    for name, words in level.items():
        same = f"shows what {name} shows: level" if len(words) >= LEAST_LEVEL else f"level with {name}"
        lines.append(f"  {same} in {', '.join(words)}")
    lines += [f"  {name} is better in {', '.join(words)}" for name, words in lost.items()]
    return "\n".join([*lines, *_off_path(rows, model), *_table(means, model)])


def _off_path(rows: Sequence[Mapping[str, Any]], model: str) -> list[str]:
    """Image PSNR of each view whose truth is known, at most four views, beside the best baseline's."""
    found: dict[str, dict[str, list[Mapping[str, Any]]]] = {}
    for row in mean_rows(rows):
        is_image = (row["protocol"], row["metric"], row["region"]) == ("image", "image_psnr_db", "all")
        if is_image and row["split"] != HELD_OUT and not math.isnan(row["value"]):
            found.setdefault(row["split"], {}).setdefault(row["recipe"], []).append(row)
    lines = []
    for view, cameras in found.items():
        means = {name: _mean(mine) for name, mine in cameras.items()}
        whole = over_most_frames({name: mean.n_defined for name, mean in means.items() if name != model})
        if model in means and whole:
            best = max(sorted(whole), key=lambda name: means[name].value)
            mine, other = means[model].value, means[best].value
            lines.append(f"  view {view}: images {mine:.1f} dB, the best baseline {other:.1f} ({best})")
    return lines[:_MOST_VIEWS]


def _means(rows: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, _Mean]]:
    """Method to metric to its mean, of the shown metrics."""
    found: dict[str, dict[str, list[Mapping[str, Any]]]] = {}
    shown = {(protocol, metric) for protocol, metric, *_ in _SHOWN}
    for row in mean_rows(rows):
        if (row["protocol"], row["metric"]) in shown and (row["split"], row["region"]) == (HELD_OUT, "all"):
            found.setdefault(row["recipe"], {}).setdefault(row["metric"], []).append(row)
    return {
        method: {metric: _mean(cameras) for metric, cameras in metrics.items()}
        for method, metrics in found.items()
    }


def _mean(cameras: Sequence[Mapping[str, Any]]) -> _Mean:
    n_defined, n_frames = (sum(row[key] for row in cameras) for key in ("n_defined", "n_frames"))
    return _Mean(sum(row["value"] for row in cameras) / len(cameras), n_defined, n_defined < n_frames)


def _table(means: Mapping[str, Mapping[str, _Mean]], model: str) -> list[str]:
    methods = [model, *(name for name in BASELINES if name in means)]
    shown = [row for row in _SHOWN if any(row[1] in means[name] for name in methods)]
    lines = ["  " + "".join([f"{'':14}", *(f"{heading:>9} " for _, _, heading, *_ in shown)])]
    for name in methods:
        cells = [_cell(means[name].get(metric), digits) for _, metric, _, digits, _ in shown]
        lines.append("  " + "".join([f"{name:14}", *cells]))
    return [*(line.rstrip() for line in lines), f"  {_LEGEND}", f"  {_PARTIAL}"]


def _cell(mean: _Mean | None, digits: int) -> str:
    if mean is None or math.isnan(mean.value):
        return f"{'-':>9} "
    return f"{mean.value:9.{digits}f}{'*' if mean.is_partial else ' '}"
