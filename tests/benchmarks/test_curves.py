"""Curves of error over training time: measured at small scale, on the tiny drive."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.speed_error import run as curve_run
from benchmarks.speed_error.curves import asked_from, is_done
from benchmarks.speed_error.document import write_document
from benchmarks.speed_error.lidar import SECTORS, WHOLE
from benchmarks.speed_error.plan import OneRun, read_result, split_of, write_result
from benchmarks.speed_error.scoring import thin_pinhole, thinned
from benchmarks.speed_error.sizes import SIZES, chosen_size
from nvsf_core.drives.catalogue import SceneEntry, load_catalogue
from nvsf_core.errors import DataError
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.recipe.presets import preset
from nvsf_core.recipe.residual import FieldSpec, TrainingSpec
from nvsf_core.reporting.speed_error import METRICS, Point, curve, pareto_front, read_runs
from nvsf_core.reporting.speed_plots import speed_section
from nvsf_core.stages import RunConfig, SceneRun, run_named_stage

MARKS_S = (*np.arange(0.001, 300.0, 0.001).tolist(), 3600.0)
"""A millisecond apart: every step passes some."""
TRAINING = TrainingSpec(steps=5, rays=128)
SMOKE = replace(
    preset("smoke"), lidar_field=FieldSpec(levels=2, log2_table=8), lidar_training=TRAINING,
    depth_training=replace(TRAINING, rays=512),
)  # fmt: skip


@pytest.fixture(scope="module")
def scene(tiny_catalogue: Path) -> SceneEntry:
    return next(entry for entry in load_catalogue([tiny_catalogue], None) if entry.name == "tiny")


@pytest.fixture(scope="module")
def setting(scene: SceneEntry, tmp_path_factory: pytest.TempPathFactory) -> curve_run.Setting:
    folder = tmp_path_factory.mktemp("curves")
    made = curve_run.Setting(
        split=split_of(scene, "full"), home=folder / "home", results=folder / "results",
        marks_s=MARKS_S, progress=lambda _: None,
    )  # fmt: skip
    curve_run.prepare(made)
    return made


def run(setting: curve_run.Setting, name: str, monkeypatch: pytest.MonkeyPatch) -> dict:
    monkeypatch.setattr(curve_run, "preset", lambda asked: SMOKE if asked == "smoke" else preset(asked))
    return read_result(curve_run.run(setting, name, 0))


def test_a_run_leaves_errors_at_its_marks_and_at_the_end(setting, monkeypatch):
    result = run(setting, "smoke", monkeypatch)
    marks = {metric: [] for metric in ("chamfer_m2", "image_psnr_db", "range_abs_error_median_m")}
    for point in result["points"]:
        assert {"recipe", "scene", "seed", "seconds", "metric", "value"} <= set(point)
        # Seconds are kept to the millisecond.
        assert point["mark"] is None or point["seconds"] >= point["mark"] - 1e-3
        if point["metric"] in marks:
            marks[point["metric"]].append(point["mark"])
    # Which marks are reached is a matter of speed; that some are and the last is not, is not.
    assert marks.pop("image_psnr_db") == [None], "depths show nothing before their training has ended"
    for found in marks.values():
        assert found[-1] is None and found[:-1] and set(found[:-1]) < set(MARKS_S[:-1])
    assert result["run"]["parameters"] > 0 and result["run"]["samples_a_ray"] > 0
    # The stage `field` has nothing left to train.
    said: list[str] = []
    config = RunConfig(recipe=SMOKE, seed=0)
    run_named_stage(
        "field", SceneRun(scene=setting.split.entry, store=setting.store, config=config), said.append
    )  # fmt: skip
    assert any(f"lidar: resumed from the checkpoint at step {TRAINING.steps}" in line for line in said)
    assert not any("rays/s" in line for line in said)


def test_a_timed_paper_recipe_has_curves_for_both_sensors(setting, monkeypatch):
    smoke = preset("paper_smoke")
    # More steps than any machine takes in this time.
    small = replace(smoke, name="paper_cpu", optimiser=replace(smoke.optimiser, steps=100_000))
    monkeypatch.setattr(curve_run, "chosen_size", lambda *_: small)
    monkeypatch.setattr(curve_run, "_PROBE_STEPS", 4)
    brief = replace(setting, marks_s=(0.5, 1.5))
    result = read_result(curve_run.run(brief, "paper_cpu", 0))
    at_end = {point["metric"] for point in result["points"] if point["mark"] is None}
    assert {"chamfer_m2", "image_psnr_db"} <= at_end
    steps = result["run"]["recipe_json"]["optimiser"]["steps"]
    assert 0 < steps < small.optimiser.steps and result["run"]["samples_a_ray"] == small.sampling.samples


def test_copying_needs_no_time(setting, monkeypatch):
    result = run(setting, "copy_nearest", monkeypatch)
    assert {point["seconds"] for point in result["points"]} == {0.0}
    assert {point["mark"] for point in result["points"]} == {None}


def test_copied_images_are_not_scored_where_those_trained_on_are_smaller(setting, scene, monkeypatch):
    smaller = replace(setting, split=replace(split_of(scene, "images2"), name="full"))
    metrics = {point["metric"] for point in run(smaller, "copy_nearest", monkeypatch)["points"]}
    assert "chamfer_m2" in metrics and "image_psnr_db" not in metrics


def test_sectors_are_a_quarter_of_the_pano_and_the_same_cells():
    whole, part = WHOLE, SECTORS
    assert 0.24 < len(part.columns) / whole.width < 0.26
    range_m = np.random.default_rng(0).uniform(1.0, 80.0, (whole.height, whole.width))
    points = {tuple(point) for point in whole.points(range_m).round(6).tolist()}
    assert {tuple(point) for point in part.points(range_m[:, part.columns]).round(6).tolist()} < points


@pytest.mark.parametrize(("width", "height"), [(64, 48), (1242, 375), (7, 5)])
def test_a_thin_camera_looks_through_exactly_the_kept_pixels(width, height):
    axis = {"cx": width / 2 - 0.3, "cy": height / 2}
    camera = Pinhole(fx=4.0 * width, fy=3.9 * width, width=width, height=height, **axis)
    rays = camera.rays(camera.pixels()).reshape(1, height, width, 3)
    thin = thin_pinhole(camera)
    found = thin.rays(thin.pixels()).reshape(1, thin.height, thin.width, 3)
    np.testing.assert_allclose(found, thinned(rays), atol=1e-12)


def entry(frames: int = 32) -> SceneEntry:
    return SceneEntry(
        name="s", root=Path("drive"), sequence="x", first_frame=100, last_frame=99 + frames,
        test_frames=(104, 112, 120, 128),
    )  # fmt: skip


def test_no_split_trains_a_scored_frame_and_val_never_sees_the_held_out_ones():
    scene = entry()
    for name in ("full", "val", "every2", "every4", "frames8", "frames16", "images2"):
        split = split_of(scene, name)
        assert split.scored and not set(split.trained) & (set(split.scored) | set(scene.test_frames))
    assert not set(split_of(scene, "val").scored) & set(scene.test_frames)
    assert len(split_of(scene, "every4").trained) == 7
    assert split_of(scene, "images4").image_divisor == 4


@pytest.mark.parametrize("name", ["every", "full2", "frames33", "third"])
def test_an_unknown_split_is_refused(name):
    with pytest.raises(DataError, match="split"):
        split_of(entry(), name)


def test_nothing_on_the_front_is_beaten_by_anything_quicker():
    draws = np.random.default_rng(3)
    curves = {
        name: [
            Point(mark_s=None, seconds=float(s), value=float(v), spread=None, seeds=1)
            for s, v in draws.uniform(0.0, 1.0, (20, 2))
        ]
        for name in ("a", "b")
    }
    for metric in METRICS[:2]:
        sign = -1.0 if metric.higher_is_better else 1.0
        front = {id(point) for _, point in pareto_front(curves, metric)}
        for point in curves["a"] + curves["b"]:
            others = [o for o in curves["a"] + curves["b"] if o is not point and o.seconds <= point.seconds]
            assert (id(point) in front) == all(sign * o.value > sign * point.value for o in others)


def write_invented(results: Path, split: str, recipe: str, seed: int, value: float, identity: str) -> None:
    facts = {
        "recipe": recipe, "scene": "s", "split": split, "seed": seed, "protocol": "p", "trained": [1, 2],
        "scored": [3], "machine": "a machine", "commit": "c0ffee", "image_px": [], "stage_seconds": {},
        "recipe_identity": identity, "train_seconds": 60.0, "parameters": 12345, "run_seconds": 90.0,
        "clock_seconds": {"both": 61.0},
    }  # fmt: skip
    points = [
        {"recipe": recipe, "scene": "s", "seed": seed, "mark": mark, "seconds": seconds,
         "metric": "chamfer_m2", "value": value * share}
        for mark, seconds, share in ((5.0, 5.1, 2.0), (None, 61.0, 1.0))
    ]  # fmt: skip
    write_result(OneRun("s", split, recipe, seed).path(results), facts, points)


def test_the_best_size_is_chosen_and_a_run_is_repeated_only_when_its_recipe_changed(tmp_path):
    for rank, (name, size) in enumerate(SIZES.items()):
        write_invented(tmp_path, "val", name, 0, abs(rank - 2) + 1.0, size.identity())
    best = chosen_size(tmp_path, "s", 0)
    assert replace(best, name=list(SIZES)[2]) == list(SIZES.values())[2]
    assert not is_done(tmp_path, OneRun("s", "full", "paper_cpu", 0))
    write_invented(tmp_path, "full", "paper_cpu", 0, 1.0, best.identity())
    assert is_done(tmp_path, OneRun("s", "full", "paper_cpu", 0))
    write_invented(tmp_path, "full", "quick", 0, 1.0, "of another day")
    assert not is_done(tmp_path, OneRun("s", "full", "quick", 0))


def test_document_and_report_show_means_over_seeds_and_say_where_they_are_from(tmp_path):
    for seed, value in enumerate((0.02, 0.04)):
        write_invented(tmp_path / "curves", "full", "quick", seed, value, "")
    write_invented(tmp_path / "curves", "frames8", "quick", 0, 0.5, "")
    write_invented(tmp_path / "curves", "val", "paper_cpu_t13_r512_s48", 0, 0.7, "")
    write_invented(tmp_path / "curves", "val", "reproject", 0, 0.1, "")
    runs = [run for run in read_runs(tmp_path / "curves") if run["run"]["split"] == "full"]
    (end,) = (p for p in curve(runs, "quick", "chamfer_m2") if p.mark_s is None)
    assert end.value == pytest.approx(0.03) and end.seeds == 2
    document = write_document(tmp_path / "curves", tmp_path / "speed.md")
    text = document.read_text()
    assert "0.030 ± 0.014 (61 s)" in text and "how the cost grows" in text and "12,345" in text
    assert "took 6.0 minutes, scoring included, the six sizes among them" in text
    assert "| `paper_cpu_t13_r512_s48` | 61 | 0.700 | 0.00 |" in text
    assert "| `reproject` | 61 | 0.100 |  |" in text, "a baseline has no rank among sizes"
    assert all(word in text for word in ("a machine", "c0ffee", "Not measured on KITTI-360's ten scenes"))
    assert (tmp_path / "speed/s-full.png").stat().st_size < 200_000
    page = speed_section(tmp_path / "curves")
    assert "<b>0.030 ± 0.014 (61 s)</b>" in page and "c0ffee" in page
    assert speed_section(tmp_path / "nothing") == "" == speed_section(None)


def test_what_is_asked_comes_from_the_environment(tiny_catalogue):
    environ = {"NVSF_SCENES": str(tiny_catalogue), "SCENES": "tiny", "RECIPES": "quick paper_cpu",
               "SEEDS": "3 4", "SPLITS": "full every2", "MARKS": "1 2"}  # fmt: skip
    runs = list(asked_from(environ).runs())
    assert ("tiny", "every2", "quick", 4) in runs and ("tiny", "full", "mesh", 0) in runs
    # Of the paper's recipes only the first seed is trained.
    assert [run for run in runs if run[2] == "paper_cpu"] == [
        ("tiny", "full", "paper_cpu", 3), ("tiny", "every2", "paper_cpu", 3)
    ]  # fmt: skip
    assert asked_from({"NVSF_SCENES": str(tiny_catalogue)}).seeds == (0, 1, 2)
