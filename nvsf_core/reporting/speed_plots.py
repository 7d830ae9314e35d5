"""Plots of error over training time, and the section of the report that shows them."""

import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from matplotlib.axes import Axes

from nvsf_core.metrics.table import BASELINES
from nvsf_core.reporting.html import escape, image, plain_table
from nvsf_core.reporting.plots import BASELINE_COLOURS, tidy_axes
from nvsf_core.reporting.previews import empty_figure, figure_png
from nvsf_core.reporting.scene_notes import holds_paper_scene
from nvsf_core.reporting.speed_error import (
    COSTS,
    METRICS,
    Metric,
    Point,
    Run,
    cost_rows,
    curve,
    groups,
    labelled,
    pareto_front,
    provenance,
    read_runs,
    recipes_of,
)

_COLOURS = ("#1f6feb", "#8250df", "#cf222e", "#1a7f37", "#bf3989", "#9a6700")
_EARLIEST_S = 2.0
"""Place of baselines (no training) on the logarithmic axis."""
_TICKS_S = (5, 15, 30, 60, 120, 300, 600, 1800)
_INNER_SPLITS = ("val",)
"""Validation splits; their runs are not shown as results."""
_NOT_OF_PAPERS = "; not measured on KITTI-360’s ten scenes"


def curves_png(runs: Sequence[Run]) -> bytes:
    """PNG of runs of one scene and split, a panel per metric: curves, baselines' levels, the Pareto front."""
    names = recipes_of(runs)
    learned = [name for name in names if name not in BASELINES]
    colours = {name: _COLOURS[i % len(_COLOURS)] for i, name in enumerate(learned)} | BASELINE_COLOURS
    panels = []
    for metric in METRICS:
        every = {name: curve(runs, name, metric.key) for name in names}
        # An error is infinite where most rays have no rendered return.
        curves = {name: [p for p in points if math.isfinite(p.value)] for name, points in every.items()}
        curves = {name: points for name, points in curves.items() if points}
        if curves:
            panels.append((metric, curves))
    rows = math.ceil(len(panels) / 2)
    figure = empty_figure(10.4, 3.7 * rows, 110)
    all_axes = figure.subplots(rows, 2, squeeze=False).reshape(-1)
    for axes, (metric, curves) in zip(all_axes, panels, strict=False):
        _panel(axes, metric, curves, colours)
    for axes in all_axes[len(panels) :]:
        axes.set_visible(False)
    return figure_png(figure)


def speed_section(folder: Path | None, scenes: Collection[str] | None = None) -> str:
    """HTML section on the runs of these scenes (None = all) below `folder`; empty if there are none."""
    runs = [] if folder is None else read_runs(folder)
    shown = {
        key: mine
        for key, mine in groups(runs).items()
        if key[1] not in _INNER_SPLITS and (scenes is None or key[0] in scenes)
    }
    if not shown:
        return ""
    elsewhere = "" if holds_paper_scene(scene for scene, _ in shown) else _NOT_OF_PAPERS
    parts = [
        '<section id="speed"><h2>Speed against error</h2><p>How wrong each recipe is after so many seconds'
        " of training, on frames that it never saw. Scored from saved weights while the clock stood still, on"
        " a fixed quarter of the laser’s rays and a sixteenth of the pixels. Ringed, and <b>bold</b> in the"
        " tables: the Pareto front, than which nothing quicker is as good. Measured with <code>make"
        f" bench</code>{elsewhere}.</p>"
    ]
    for (scene, split), mine in shown.items():
        parts.append(f"<h3>{escape(scene)}, split {escape(split)}</h3>")
        parts.append(f'<p class="soft">{escape(provenance(mine))}</p>')
        parts.append(f"<figure>{image(curves_png(mine), f'error over time, {scene}, {split}')}</figure>")
        parts += [_table(mine, metric) for metric in METRICS]
        head = ["recipe", "seeds", *(title for _, title, _ in COSTS)]
        rows = [[escape(cell) for cell in row] for row in cost_rows(mine)]
        parts.append('<div class="label">cost</div>' + plain_table(head, rows))
    return "".join([*parts, "</section>"])


def _table(runs: Sequence[Run], metric: Metric) -> str:
    marks, rows = labelled(runs, metric)
    if not rows:
        return ""
    head = [metric.title, *(f"{mark:g} s" for mark in marks), "end of training"]
    return plain_table(head, [[escape(name), *map(_bold, cells)] for name, cells in rows])


def _bold(cell: str) -> str:
    inner = escape(cell.strip("*"))
    return f"<b>{inner}</b>" if cell.startswith("**") else inner


def _panel(
    axes: Axes, metric: Metric, curves: Mapping[str, Sequence[Point]], colours: Mapping[str, str]
) -> None:
    longest_s = max(_shown_s(point) for points in curves.values() for point in points)
    for name, points in curves.items():
        colour, seconds = colours[name], [_shown_s(point) for point in points]
        values = [point.value for point in points]
        if name in BASELINES:
            axes.hlines(values[0], seconds[0], longest_s, color=colour, linestyle=":", linewidth=1.3)
            axes.plot(seconds[:1], values[:1], "s", color=colour, label=name)
            continue
        axes.plot(seconds, values, "-o", color=colour, markersize=4, linewidth=1.6, label=name)
        spreads = [point.spread or 0.0 for point in points]
        low = [value - spread for value, spread in zip(values, spreads, strict=True)]
        high = [value + spread for value, spread in zip(values, spreads, strict=True)]
        axes.fill_between(seconds, low, high, color=colour, alpha=0.18, linewidth=0)
    front = pareto_front(curves, metric)
    axes.plot(
        [_shown_s(point) for _, point in front], [point.value for _, point in front], "o", markersize=10,
        markerfacecolor="none", markeredgecolor="#111", markeredgewidth=1.1, label="Pareto front",
    )  # fmt: skip
    better = "higher" if metric.higher_is_better else "lower"
    axes.set(
        xlabel="seconds of training and what it starts from", title=f"{metric.title}, {better} is better"
    )
    everything = [point for points in curves.values() for point in points]
    _scale(axes, everything, log_values=not metric.higher_is_better)
    tidy_axes(axes)
    axes.legend(frameon=False, fontsize=8)


def _scale(axes: Axes, points: Sequence[Point], *, log_values: bool) -> None:
    """Set logarithmic scales. Errors need one too: a coarse field's are a hundred times a good one's."""
    axes.set_xscale("log")
    longest = max(_shown_s(point) for point in points)
    ticks = [tick for tick in _TICKS_S if tick <= longest * 1.05]
    axes.set_xticks([_EARLIEST_S, *ticks], ["none", *map(str, ticks)])
    if log_values and all(point.value > 0.0 for point in points):
        axes.set_yscale("log")
        low, high = min(p.value for p in points), max(p.value for p in points)
        decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
        values = [digit * 10.0**decade for decade in decades for digit in (1, 2, 5)]
        inside = [value for value in values if low / 1.5 <= value <= high * 1.5]
        axes.set_yticks(inside, [f"{value:g}" for value in inside])
    axes.minorticks_off()


def _shown_s(point: Point) -> float:
    return max(point.seconds, _EARLIEST_S)
