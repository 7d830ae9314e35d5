import math
from typing import Any

from nvsf_core.metrics.table import COLUMNS, HEADLINES, UNITS, mean_rows, summary_table


def _row(**changed: Any) -> dict[str, Any]:
    row = dict.fromkeys(COLUMNS, 0) | {
        "scene": "demo", "split": "test", "region": "all", "protocol": "lidar4d_scan", "sensor": "lidar",
        "metric": "chamfer_m2", "unit": "m2", "recipe": "quick", "train_seconds": 55.0, "render_seconds": 0.5,
        "value": 0.04,
    }  # fmt: skip
    return row | changed


def test_means_are_of_the_defined_frames_and_say_how_many() -> None:
    rows = [_row(frame=1, value=0.04), _row(frame=2, value=math.nan), _row(frame=3, value=0.06)]
    (mean,) = mean_rows(rows)
    assert math.isclose(mean["value"], 0.05)
    assert (mean["n_defined"], mean["n_frames"]) == (2, 3)
    (none,) = mean_rows([_row(value=math.nan)])
    assert math.isnan(none["value"])
    (infinite,) = mean_rows([_row(value=math.inf), _row(value=1.0)])
    assert math.isinf(infinite["value"])


def test_the_table_puts_the_model_above_the_baselines_and_time_beside_error() -> None:
    rows = [
        _row(recipe="copy_nearest", value=0.1434, train_seconds=math.nan),
        _row(recipe="mesh", value=0.0485),
        _row(recipe="reproject", value=0.0698),
        _row(recipe="quick"),
        _row(protocol="image", sensor="image_00", metric="image_psnr_db", unit="dB", value=24.345),
    ]
    text = summary_table(rows)
    lines = text.splitlines()
    assert "lidar4d_scan" in lines[0]
    assert [line.split()[0] for line in lines[2:6]] == ["quick", "reproject", "copy_nearest", "mesh"]
    assert "0.0400" in lines[2]
    assert "55.0" in lines[2]
    assert "24.34" in text
    assert "image_00" in text


def test_undefined_means_are_dashes_and_partial_ones_are_starred() -> None:
    assert " -  " in summary_table([_row(value=math.nan)])
    assert "0.0400*" in summary_table([_row(), _row(frame=1, value=math.nan)])
    assert summary_table([]) == ""


def test_every_headline_has_a_unit() -> None:
    assert {metric for metrics in HEADLINES.values() for metric in metrics} <= set(UNITS)


def test_the_terminal_shows_the_masked_foreground_and_each_view_below_the_held_out_frames() -> None:
    rows = [
        _row(split="shift_1m", protocol="raw", value=0.06),
        _row(protocol="masked", region="foreground", value=0.11),
        _row(protocol="masked", region="background", value=0.22),
        _row(region="foreground", value=0.33),
        _row(),
        _row(protocol="lidar4d", sensor="image_00", metric="image_depth_rmse_m", unit="m", value=0.44),
    ]
    blocks = summary_table(rows).split("\n\n")
    assert ["held-out" in block for block in blocks] == [True, True, False]
    assert "foreground" in blocks[1]
    assert "view shift_1m" in blocks[2]
    assert not any(hidden in "".join(blocks) for hidden in ("0.22", "0.33", "0.44"))
