"""The residual recipes train and render on a device that is not the CPU, with the CPU's results."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from nvsf_core.demo.drive import DEMO_SEQUENCE, DemoSize, write_demo
from nvsf_core.drives.catalogue import SceneEntry
from nvsf_core.fields.depth_network import DepthNetwork
from nvsf_core.models.residual.camera import LEARNED
from nvsf_core.models.residual.camera_examples import RecordedView
from nvsf_core.models.residual.depth_step import depth_step
from nvsf_core.models.residual.family import make_fields
from nvsf_core.models.residual.family import train as train_scene
from nvsf_core.models.residual.pano import train_pano
from nvsf_core.models.residual.raydrop import train_hits
from nvsf_core.recipe.residual import FieldSpec, HitsSpec, PanoSpec, ResidualRecipe, TrainingSpec
from nvsf_core.rendering.plane_depth import image_inverse_depth
from nvsf_core.stages import plan_run, run_named_stage
from nvsf_core.stages.field import load_trained
from nvsf_core.stages.inputs import read_recording
from nvsf_core.stages.runner.checkpoints import StageSession
from nvsf_core.stages.runner.run import SceneRun
from nvsf_core.stages.runner.stage import Task
from nvsf_core.stores.checkpoints import save_tensors
from nvsf_core.training.loop import fresh_state, train
from tests.models.residual.test_depth_step import RECIPE, STEPS, example
from tests.other_device import other_device
from tests.stages.lidar_drive import FRAMES, LASERS

# Planes are compared on images shrunk by more than the others.
SHRUNK = replace(RECIPE, camera=replace(RECIPE.camera, plane_px=32 * 16))

FEW = TrainingSpec(steps=5, rays=256)
CAMERA = "image_00"
WHOLE = replace(
    RECIPE,
    name="whole",
    camera=replace(RECIPE.camera, plane_px=24 * 12, aligned=True),
    depth_training=FEW,
    lidar_field=FieldSpec(levels=2, log2_table=8),
    lidar_training=FEW,
    hits=HitsSpec(channels=8, layers=1, frames=2, training=FEW),
    pano=PanoSpec(phases=1, parts=1, channels=8, layers=1, frames=4, judge_every=2, training=FEW),
)


def learned(
    recipe: ResidualRecipe, given: RecordedView, device: torch.device
) -> tuple[list[float], np.ndarray]:
    """Losses of a few steps, and the inverse depths that are found afterwards."""
    network = DepthNetwork(recipe.camera, torch.Generator().manual_seed(0)).to(device)
    one = RecordedView(given.view.to(device), given.truth.to(device))
    spec = replace(STEPS, steps=10)
    state = fresh_state(network, spec, 1)
    train(
        state, spec, lambda _, generator: [lambda: [depth_step(network, [one], recipe, generator)]],
        lambda *_: None, lambda _: None,
    )  # fmt: skip
    found = image_inverse_depth(network, one.view, recipe.camera).cpu().numpy()
    return [row["loss"] for row in state.curve], found


def test_the_depth_network_learns_and_finds_elsewhere_what_it_does_on_the_cpu() -> None:
    for recipe in (RECIPE, SHRUNK):
        losses, inverse = learned(recipe, example(recipe.camera), torch.device("cpu"))
        with other_device() as device:
            found, there = learned(recipe, example(recipe.camera), device)
        assert np.allclose(found, losses, rtol=5e-3)
        # Where two planes are equally likely the last bit may decide.
        assert np.mean(np.abs(there - inverse) > 1e-3) < 0.02


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> SceneRun:
    """A drive with a camera and moving cars, all stages before training run."""
    folder = tmp_path_factory.mktemp("elsewhere")
    size = DemoSize(
        frames=FRAMES, lasers=LASERS, firings=200, cameras=(CAMERA,), width=96, height=48, fisheye_side=0
    )
    write_demo(folder / "drive", size=size, traffic=2)
    scene = SceneEntry(
        name="elsewhere", root=folder / "drive", sequence=DEMO_SEQUENCE, first_frame=0,
        last_frame=FRAMES - 1, test_frames=(4,), sweep_period_s=0.1,
    )  # fmt: skip
    run = plan_run(scene, folder / "home", recipe=WHOLE)
    for stage in ("frames", "sweeps", "undistorted", "pano", "evidence"):
        run_named_stage(stage, run, lambda line: None)
    return run


def trained_and_shown(run: SceneRun, work: Path) -> tuple[list[float], np.ndarray]:
    """Losses of all networks and scores on validation scans, and an image."""
    work.mkdir()
    task = Task(scene=run.scene, store=run.store, config=run.config, folder=work, progress=lambda _: None)
    session, recording = StageSession(task, work), read_recording(run.store)
    trained = train_scene(WHOLE, recording, session)
    assert all(value.device.type == "cpu" for value in trained.tensors.values())
    # These train and render whether or not `choose` would use them, and from the start.
    session = StageSession(task, work / "apart")
    session.work.mkdir()
    fields = make_fields(WHOLE, recording, 0)
    assert fields.lidar and fields.hits and fields.pano and recording.lidar
    hits = train_hits(session, fields.hits, fields.lidar, WHOLE, recording.lidar)
    pano = train_pano(session, fields.pano, fields.lidar, WHOLE, recording.lidar, hits.correct)
    curves = [*trained.curves.values(), hits.states["hits"].curve, pano.states["pano"].curve]
    judged = [float(hits.metadata["hits_judged_nats"]), float(pano.metadata["pano_judged_psnr_db"])]
    save_tensors(work / "weights.safetensors", trained.tensors, trained.facts | {LEARNED: [CAMERA]})
    (work / "recipe.json").write_text(json.dumps(WHOLE.to_json()))
    model = load_trained(work, recording)
    assert model.camera is not None
    images = recording.cameras[CAMERA].training
    shown = model.camera(CAMERA, images.pinhole, images.pose[2], 0.2)
    return [row["loss"] for curve in curves for row in curve] + judged, shown.rgb


def test_a_whole_scene_trains_elsewhere_as_on_the_cpu(run: SceneRun, tmp_path: Path) -> None:
    expected, image = trained_and_shown(run, tmp_path / "here")
    with other_device():
        found, shown = trained_and_shown(run, tmp_path / "there")
    assert len(found) > 5 and np.allclose(found, expected, rtol=1e-2)
    assert np.abs(shown.astype(float) - image).mean() < 1.0
