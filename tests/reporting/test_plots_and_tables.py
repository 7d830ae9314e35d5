"""Pictures show errors for what they are, and tables mark the best and nothing else."""

import io
import math
from dataclasses import replace

import numpy as np
from PIL import Image

from nvsf_core.reporting import plots
from nvsf_core.reporting.html import Column, best_rows, escape, number


def _open(content: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB"))


def test_missed_invented_and_empty_rays_have_colours_of_their_own() -> None:
    recorded_m = np.array([[0.0, 10.0, 0.0, 10.0, 10.0]])
    rendered_m = np.array([[0.0, 0.0, 10.0, 10.0, 12.0]])
    row = _open(plots.error_image_png(recorded_m, rendered_m))[0]
    assert tuple(row[0]) == (0, 0, 0)
    assert tuple(row[1]) == plots.MISSED_COLOUR
    assert tuple(row[2]) == plots.INVENTED_COLOUR
    assert len({tuple(pixel) for pixel in row}) == 5
    assert row[4].sum() > row[3].sum() > 0, "a larger error is brighter"


def test_an_images_error_is_dark_where_it_is_right_and_brightest_from_a_quarter_of_the_range() -> None:
    truth = np.full((1, 4, 3), 100, np.uint8)
    rendered = truth + np.array([0, 16, 64, 150], np.uint8)[None, :, None]
    row = _open(plots.image_error_png(truth, rendered))[0].astype(int).sum(axis=-1)
    assert 0 < row[0] < row[1] < row[2] == row[3]


def test_a_curve_with_a_sensor_column_gets_a_panel_each() -> None:
    curve = {"sensor": ["lidar"] * 3 + ["camera"] * 3, "step": [1, 2, 3] * 2, "seconds": [0.1, 0.2, 0.3] * 2,
             "loss": [3.0, 2.0, 1.0] * 2, "depth": [1.0, 0.5, 0.2, None, None, None]}  # fmt: skip
    both = _open(plots.curve_png(curve))
    one = _open(plots.curve_png({name: column[:3] for name, column in curve.items()}))
    assert both.shape[1] > 1.5 * one.shape[1]


def test_an_undefined_or_infinite_error_is_left_out_of_the_plot() -> None:
    points = [
        plots.CostPoint(label=str(error), seconds=1.0, error=error, colour="#000000")
        for error in (math.nan, math.inf, 0.1)
    ]
    _open(plots.cost_error_png([("error", points)]))
    _open(plots.cost_error_png([("error", points[:2])]))


def _column(values: list[float], higher: bool | None) -> Column:
    notes = [""] * len(values)
    return Column(
        group="g", title="t", unit="", higher_is_better=higher, values=values, notes=notes, digits=2
    )


def test_the_best_is_marked_in_the_right_direction_ties_shared_and_undefined_never() -> None:
    assert best_rows(_column([0.1, 0.2, math.nan], False)) == {0}
    assert best_rows(_column([0.1, 0.2, math.inf], True)) == {1}
    assert best_rows(_column([0.101, 0.1, 0.3], False)) == {0, 1}
    assert best_rows(_column([0.1, math.nan], False)) == set()
    assert best_rows(_column([1.0, 2.0], None)) == set()


def test_a_mean_over_fewer_frames_than_another_is_never_the_best() -> None:
    column = _column([0.3, 0.1, 0.4], False)
    assert best_rows(replace(column, n_defined=[4, 3, 4])) == {0}
    assert best_rows(replace(column, n_defined=[3, 3, 3])) == {1}
    assert best_rows(replace(column, n_defined=[3, 3, 4], values=[0.3, 0.1, math.inf])) == set()


def test_numbers_are_written_for_people() -> None:
    assert [number(v, 2) for v in (math.nan, math.inf, 0.126, 1234.5)] == ["–", "∞", "0.13", "1234.50"]
    assert number(1234567, 0) == "1 234 567"
    assert escape("<b>&") == "&lt;b&gt;&amp;"
