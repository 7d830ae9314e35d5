"""Curves of error over training time: measured at small scale, on the tiny drive."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks import curve_run
from benchmarks.curve_plan import Split, read_result, split_of
from benchmarks.curve_scoring import Sectors, judge_of, thin_pinhole, thinned
from nvsf_core.errors import DataError
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.kitti360.catalogue import SceneEntry, load_catalogue
from nvsf_core.recipe import FieldSpec, TrainingSpec, preset
from nvsf_core.sensors.linear_pano import LinearPano
from nvsf_core.stages.recording import read_recording

MARKS_S = (*np.geomspace(0.01, 60.0, 60).tolist(), 3600.0)
TRAINING = TrainingSpec(steps=5, rays=128, threads=1)
SMOKE = replace(
    preset("smoke"), lidar_field=FieldSpec(levels=2, log2_table=8), lidar_training=TRAINING,
    depth_training=replace(TRAINING, rays=512), camera_training=replace(TRAINING, rays=512),
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
        assert point["mark"] is None or point["seconds"] >= point["mark"]
        if point["metric"] in marks:
            marks[point["metric"]].append(point["mark"])
    # Which marks are reached is a matter of speed; that some are and the last is not, is not.
    for found in marks.values():
        assert found[-1] is None and found[:-1] and set(found[:-1]) < set(MARKS_S[:-1])
    assert result["run"]["parameters"] > 0 and result["run"]["samples_a_ray"] > 0


def test_a_timed_paper_recipe_has_curves_for_both_sensors(setting, monkeypatch):
    small = replace(preset("paper_smoke"), name="paper_cpu")
    monkeypatch.setattr(curve_run, "chosen_size", lambda *_: small)
    monkeypatch.setattr(curve_run, "_PROBE_STEPS", 4)
    brief = replace(setting, marks_s=(0.5, 1.5))
    result = read_result(curve_run.run(brief, "paper_cpu", 0))
    at_end = {point["metric"] for point in result["points"] if point["mark"] is None}
    assert {"chamfer_m2", "image_psnr_db"} <= at_end
    steps = result["run"]["recipe_json"]["optimiser"]["steps"]
    assert steps != small.optimiser.steps and result["run"]["samples_a_ray"] == small.sampling.samples
