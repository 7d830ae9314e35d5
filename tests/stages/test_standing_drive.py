"""A drive that stands in traffic: copying the nearest scan is hard to beat there, and must not win."""

from dataclasses import replace

import numpy as np
import pytest

from nvsf_core.demo.motion import EgoSpeed
from nvsf_core.metrics.protocols import Scan, lidar4d, project_scan
from nvsf_core.models.baselines.reproject import reprojection
from nvsf_core.recipe.presets import preset
from nvsf_core.recipe.residual import FieldSpec, TrainingSpec
from nvsf_core.sensors.linear_pano import LinearPano
from nvsf_core.simulation.sweep_simulation import simulate_sweep
from nvsf_core.stages import run_named_stage
from nvsf_core.stages.field import load_trained
from nvsf_core.stages.inputs import read_recording
from nvsf_core.stages.views.lidar import copied_scans
from nvsf_core.stages.views.view import held_out_view
from tests.stages.lidar_drive import FRAMES, proven_drive

HELD_OUT = (2, 4, 6)
RECIPE = replace(
    preset("smoke"),
    lidar_field=FieldSpec(levels=2, log2_table=8),
    lidar_training=TrainingSpec(steps=60, rays=1024),
)
PANO = LinearPano(reference_quirks=True)
KEYS = ("points_m", "intensity", "laser")


@pytest.fixture(scope="module")
def static(tmp_path_factory: pytest.TempPathFactory) -> dict[str, np.ndarray]:
    """Mean CD, F and range PSNR of the held-out scans (`lidar4d_scan`), by method."""
    run = proven_drive(
        tmp_path_factory.mktemp("standing"), RECIPE, firings=1000, held_out=HELD_OUT,
        speed=EgoSpeed(speeds_m_s=(0.0,)), traffic=4,
    )  # fmt: skip
    run_named_stage("field", run, lambda line: None)
    recording = read_recording(run.store)
    view = held_out_view(recording, HELD_OUT)
    assert recording.lidar is not None and view is not None and view.sweeps is not None
    lidar, plan = recording.lidar, view.sweeps
    stationary = lidar.evidence.stationary
    assert stationary is not None and len(stationary.scan) == FRAMES - len(HELD_OUT)
    copied = copied_scans(lidar, plan)
    found = {"copy_nearest": _scores(lidar.sweeps.arrays, copied)}
    models = {
        "reproject": reprojection(recording),
        "model": load_trained(run.store.require("field/smoke/0"), recording),
    }
    for name, model in models.items():
        assert model.lidar is not None
        made = [
            simulate_sweep(replace(model, correct=None), lidar, plan, float(instant))
            for instant in plan.time_s
        ]
        joined = {key: np.concatenate([getattr(one, key) for one in made]) for key in KEYS}
        joined["offsets"] = np.cumsum([0, *(len(one.laser) for one in made)])
        found[name] = _scores(lidar.sweeps.arrays, joined)
    return found


def _scores(recorded: dict[str, np.ndarray], predicted: dict[str, np.ndarray]) -> np.ndarray:
    scores = []
    for number, frame in enumerate(HELD_OUT):
        truth = _scan(recorded, int(np.flatnonzero(recorded["frame"] == frame)[0]))
        images = [project_scan(PANO, scan) for scan in (_scan(predicted, number), truth)]
        measures = lidar4d(images[0], images[1], PANO, None)
        scores.append([measures[name].value for name in ("chamfer_m2", "f_score", "range_psnr_db")])
    mean: np.ndarray = np.mean(scores, axis=0)
    return mean


def _scan(arrays: dict[str, np.ndarray], number: int) -> Scan:
    part = slice(*arrays["offsets"][number : number + 2].tolist())
    return Scan(**{key: arrays[key][part] for key in KEYS})


@pytest.mark.parametrize("method", ["reproject", "model"])
def test_copying_never_wins_where_the_sensor_stands(static: dict[str, np.ndarray], method: str) -> None:
    chamfer_m2, f_score, psnr_db = static[method]
    copied_chamfer_m2, copied_f_score, copied_psnr_db = static["copy_nearest"]
    assert chamfer_m2 <= copied_chamfer_m2
    assert f_score >= copied_f_score
    assert psnr_db >= copied_psnr_db
