"""The few lines that a run ends with."""

import math

from nvsf_core.metrics.headline import headline
from tests.metrics.test_table import _row


def rows_of(method: str, chamfer_m2: float, f_score: float) -> list[dict]:
    return [
        _row(recipe=method, value=chamfer_m2),
        _row(recipe=method, metric="f_score", unit="1", value=f_score),
        _row(recipe=method, metric="f_score", unit="1", value=0.0, split="shift_1m"),
    ]


def test_it_says_where_the_model_wins_and_which_baseline_wins_elsewhere() -> None:
    rows = [*rows_of("mesh", 0.02, 0.90), *rows_of("reproject", 0.03, 0.97), *rows_of("quick", 0.01, 0.95)]
    lines = headline(rows).splitlines()
    assert lines[0] == "demo: quick beats every baseline in CD"
    assert lines[1] == "  reproject is better in F"
    assert [line.split()[0] for line in lines[3:6]] == ["quick", "reproject", "mesh"]
    assert lines[3].split()[1:] == ["0.0100", "0.9500"]


def test_a_model_that_shows_what_a_baseline_shows_is_level_with_it() -> None:
    rows = [*rows_of("mesh", 0.02, 0.90), *rows_of("reproject", 0.01, 0.97), *rows_of("quick", 0.01, 0.97)]
    lines = headline(rows).splitlines()
    assert lines[0] == "demo: quick beats every baseline in nothing"
    assert lines[1] == "  shows what reproject shows: level in CD, F"
    rows = [*rows_of("mesh", 0.02, 1.0), *rows_of("quick", 0.01, 1.0)]
    assert headline(rows).splitlines()[:2] == [
        "demo: quick beats every baseline in CD",
        "  level with mesh in F",
    ]


def test_it_fits_a_terminal_of_eighty_columns() -> None:
    every = [("lidar4d_scan", name) for name in ("chamfer_m2", "f_score", "range_psnr_db", "hit_accuracy")]
    every += [("image", name) for name in ("image_psnr_db", "image_lpips_squeeze")]
    rows = [
        _row(recipe=method, protocol=protocol, metric=metric, value=12.0 + len(method))
        for method in ("lean", "reproject", "copy_nearest", "mesh")
        for protocol, metric in every
    ]
    lines = headline(rows).splitlines()
    assert len(lines) <= 10 and max(map(len, lines)) <= 80


def test_what_nobody_measured_is_neither_won_nor_lost() -> None:
    rows = [_row(recipe="quick", value=math.nan), _row(recipe="reproject", value=math.nan)]
    assert headline(rows).splitlines()[0] == "demo: quick beats every baseline in nothing"
    assert headline([_row(recipe="reproject")]) == "" and headline([]) == ""


def test_a_mean_over_fewer_frames_is_starred() -> None:
    rows = [
        _row(recipe="quick"),
        _row(recipe="quick", frame=1, value=math.nan),
        _row(recipe="mesh", value=1.0),
    ]
    lines = headline(rows).splitlines()
    assert "0.0400*" in lines[2] and "1.0000" in lines[3] and "*" not in lines[3]


def test_who_gives_nothing_in_a_hard_frame_is_neither_better_nor_hides_who_is() -> None:
    def rows(**frames_m2: tuple[float, float]) -> list[dict]:
        return [
            _row(recipe=method, frame=frame, value=value)
            for method, values in frames_m2.items()
            for frame, value in enumerate(values)
        ]

    spared = headline(rows(quick=(0.2, 4.0), copy_nearest=(0.1, math.nan), mesh=(0.5, 5.0)))
    assert spared.splitlines()[0] == "demo: quick beats every baseline in CD"
    assert "copy_nearest is better" not in spared
    alone = headline(rows(quick=(0.2, 4.0), copy_nearest=(0.1, math.nan)))
    assert alone.splitlines()[0] == "demo: quick beats every baseline in CD"
    model = headline(rows(quick=(0.1, math.nan), mesh=(0.2, 4.0)))
    assert model.splitlines()[0] == "demo: quick beats every baseline in nothing"
    assert "mesh is better" not in model
    nothing = headline(rows(quick=(math.nan, math.nan), mesh=(0.2, 4.0)))
    assert "mesh is better in CD" in nothing


def test_images_off_the_path_stand_beside_the_best_baselines() -> None:
    def image(method: str, value: float, split: str) -> dict:
        return _row(recipe=method, protocol="image", metric="image_psnr_db", value=value, split=split)

    off = [
        image("quick", 25.4, "shift_1m"),
        image("reproject", 21.1, "shift_1m"),
        image("mesh", 20.8, "shift_1m"),
    ]
    views = [image(method, 20.0, f"view_{number}") for method in ("quick", "mesh") for number in range(9)]
    lines = headline([*rows_of("quick", 0.01, 0.95), *rows_of("mesh", 0.02, 0.90), *off, *views]).splitlines()
    assert "  view shift_1m: images 25.4 dB, the best baseline 21.1 (reproject)" in lines
    assert len([line for line in lines if line.startswith("  view ")]) == 4 and len(lines) <= 14
