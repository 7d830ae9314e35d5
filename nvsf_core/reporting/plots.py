"""The report's pictures, each as the bytes of a PNG."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes

from nvsf_core.reporting.previews import (
    MAX_RANGE_M,
    empty_figure,
    figure_png,
    indexed_png,
    palette_png,
    range_preview,
)

MAX_ERROR_M = 1.0
MAX_ERROR_LEVELS = 64
"""Of 255: a pixel's mean error that is shown as the worst."""
MISSED_COLOUR, INVENTED_COLOUR = (64, 196, 255), (232, 62, 200)
MODEL_COLOUR, BASELINE_COLOURS = (
    "#1f6feb",
    {"reproject": "#d9822b", "copy_nearest": "#6b7280", "mesh": "#5b8c5a"},
)
RANGE_TICKS_M = (0, 5, 20, 45, 80)
"""Ticks of the range scale, which is linear in the square root."""
_DPI = 144
_ROW_REPEAT = 2
_LABEL_PT = (70.0, 10.0)
"""Width and height of a point's label, in points."""
_MISSED, _INVENTED, _LEVELS = 254, 255, 252


@dataclass(frozen=True, slots=True, kw_only=True)
class CostPoint:
    """One method of one scene: its training time and its error."""

    label: str
    seconds: float
    """Training time; 0 for a method that learns nothing."""
    error: float
    colour: str


def range_image_png(range_m: np.ndarray) -> bytes:
    """PNG of a range image (H, W) in metres; no return is black."""
    return range_preview(range_m, row_repeat=_ROW_REPEAT)


def range_scale_png() -> bytes:
    """PNG of the colour scale of `range_image_png`, 0 to 80 m."""
    return indexed_png(np.tile(np.arange(1, 256), (8, 1)), "turbo")


def error_image_png(recorded_m: np.ndarray, rendered_m: np.ndarray) -> bytes:
    """PNG of |rendered - recorded| of two range images (H, W) in metres: dark = 0, yellow = 1 m or more.

    Black = no return in either; blue = recorded, but missed; pink = rendered, but not recorded.
    """
    recorded = np.isfinite(recorded_m) & (recorded_m > 0.0)
    rendered = np.isfinite(rendered_m) & (rendered_m > 0.0)
    both = recorded & rendered
    error_m = np.abs(np.where(both, rendered_m, 0.0) - np.where(both, recorded_m, 0.0))
    levels = np.where(both, 1 + np.rint(np.clip(error_m / MAX_ERROR_M, 0.0, 1.0) * _LEVELS), 0)
    levels[recorded & ~rendered] = _MISSED
    levels[rendered & ~recorded] = _INVENTED
    return palette_png(levels, _error_palette(), _ROW_REPEAT)


def image_error_png(truth_rgb: np.ndarray, rendered_rgb: np.ndarray) -> bytes:
    """PNG of the mean absolute error of each pixel of two images (H, W, 3) uint8: dark = 0, yellow = 64."""
    error = np.abs(rendered_rgb.astype(np.int16) - truth_rgb.astype(np.int16)).mean(axis=-1)
    levels = 1 + np.rint(np.clip(error / MAX_ERROR_LEVELS, 0.0, 1.0) * _LEVELS)
    return palette_png(levels, _error_palette())


def error_scale_png() -> bytes:
    """PNG of the colour scale of `error_image_png`, 0 to 1 m, and of `image_error_png`, 0 to 64 levels."""
    return palette_png(np.tile(np.arange(1, _LEVELS + 2), (8, 1)), _error_palette())


def curve_png(curve: dict[str, list[Any]]) -> bytes:
    """PNG of the loss and its terms over seconds, one panel per value of the first text column.

    Args:
        curve: Columns `step`, `seconds`, `loss`; other numeric columns are terms of the loss, except speeds,
            memory and rates, which are left out.
    """
    words = [name for name, column in curve.items() if column and isinstance(column[0], str)]
    groups = sorted(set(curve[words[0]])) if words else [""]
    figure = empty_figure(4.6 * len(groups) + 0.6, 3.2, _DPI)
    all_axes = figure.subplots(1, len(groups), squeeze=False)[0]
    for axes, group in zip(all_axes, groups, strict=True):
        rows = [i for i in range(len(curve["step"])) if not words or curve[words[0]][i] == group]
        seconds = np.array([curve["seconds"][i] for i in rows], dtype=float)
        for name, column in curve.items():
            if name in ("step", "seconds", *words) or name.endswith(("_per_s", "_mb", "_rate")):
                continue
            # Terms that the sensor of this panel does not have are stored as None.
            values = np.array([np.nan if column[i] is None else column[i] for i in rows], dtype=float)
            values[values <= 0.0] = np.nan
            if np.isnan(values).all():
                continue
            is_total = name == "loss"
            axes.plot(
                seconds,
                values,
                label=name,
                linewidth=2.0 if is_total else 1.0,
                alpha=1.0 if is_total else 0.8,
                color=MODEL_COLOUR if is_total else None,
            )
        axes.set(xlabel="seconds of training", ylabel="loss", yscale="log", title=group)
        if axes.lines:
            axes.legend(frameon=False, fontsize=8)
        tidy_axes(axes)
    return figure_png(figure)


def cost_error_png(panels: Sequence[tuple[str, Sequence[CostPoint]]]) -> bytes:
    """PNG of error over training time, one panel per metric; seconds are linear up to 1, then logarithmic."""
    figure = empty_figure(4.6 * len(panels) + 0.4, 3.4, _DPI)
    all_axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for axes, (title, points) in zip(all_axes, panels, strict=True):
        finite = [p for p in points if math.isfinite(p.seconds) and math.isfinite(p.error)]
        for point in finite:
            axes.scatter(point.seconds, point.error, s=60, color=point.colour, zorder=3, edgecolor="white")
        axes.set(xlabel="seconds of training", title=title)
        axes.set_xscale("symlog", linthresh=1.0)
        longest = max((p.seconds for p in finite), default=1.0)
        # Room on the right for the labels.
        axes.set_xlim(-0.3, max(10.0, longest * 20.0))
        ticks = [tick for tick in (0, 1, 10, 100, 1_000, 10_000) if tick <= max(10.0, longest * 20.0)]
        axes.set_xticks(ticks, [str(tick) for tick in ticks])
        axes.minorticks_off()
        axes.margins(y=0.25)
        tidy_axes(axes)
        _label(axes, finite)
    return figure_png(figure)


def _label(axes: Axes, points: Sequence[CostPoint]) -> None:
    """Write each point's name on its right; a label that would overlap a lower one is moved up."""
    points_per_pixel = 72.0 / axes.figure.dpi
    named: list[tuple[float, float]] = []
    for point in sorted(points, key=lambda point: point.error):
        right, height = axes.transData.transform((point.seconds, point.error)) * points_per_pixel
        label = height - 4.0
        # Points come from the lowest up, so a label only has to clear those placed before it.
        for other_right, other in named:
            if abs(right - other_right) < _LABEL_PT[0]:
                label = max(label, other + _LABEL_PT[1])
        named.append((right, label))
        axes.annotate(
            point.label, (point.seconds, point.error), textcoords="offset points",
            xytext=(8, label - height), fontsize=8, color=point.colour,
        )  # fmt: skip


def range_tick_percent(range_m: float) -> float:
    """Position of a range on the scale of `range_scale_png`, in percent from its left end."""
    return 100.0 * math.sqrt(range_m / MAX_RANGE_M)


def _error_palette() -> np.ndarray:
    palette = np.zeros((256, 3), np.uint8)
    # From 0.15: zero error must differ from "no return", which is black.
    palette[1 : _LEVELS + 2] = np.rint(colormaps["inferno"](np.linspace(0.15, 1.0, _LEVELS + 1))[:, :3] * 255)
    palette[_MISSED], palette[_INVENTED] = MISSED_COLOUR, INVENTED_COLOUR
    return palette


def tidy_axes(axes: Axes) -> None:
    """The common look of all plots: a light grid, two spines, a small title."""
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    axes.title.set_fontsize(10)
