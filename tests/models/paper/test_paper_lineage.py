"""The paper's recipes go through the whole lineage, and a killed training ends as if it had not been."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from nvsf_core.demo.drive import DEMO_SEQUENCE, DemoSize, write_demo
from nvsf_core.drives.catalogue import SceneEntry
from nvsf_core.models.paper.camera_step import camera_losses
from nvsf_core.models.paper.family import train_on_frames
from nvsf_core.models.paper.scene import training_frames
from nvsf_core.models.paper.step import paper_step
from nvsf_core.models.paper.training_frames import PaperTrainee
from nvsf_core.recipe.base import Recipe
from nvsf_core.recipe.paper import PaperLosses, PaperRecipe, ReferenceQuirks
from nvsf_core.recipe.presets import preset
from nvsf_core.recording.drive import Recording
from nvsf_core.sensors.linear_pano import LinearPano
from nvsf_core.simulation.scene_model import SceneModel
from nvsf_core.stages import plan_run, run_named_stage, run_scene
from nvsf_core.stages.field import load_model
from nvsf_core.stages.inputs import read_recording
from nvsf_core.stages.runner.checkpoints import StageSession
from nvsf_core.stages.runner.stage import Task
from nvsf_core.stages.views.lidar import along_recorded_rays, sweep_arrays
from nvsf_core.stages.views.view import held_out_view
from nvsf_core.stores.arrays import read_arrays
from nvsf_core.stores.checkpoints import load_tensors
from nvsf_core.stores.scene_store import SceneStore
from nvsf_core.stores.tables import read_rows, read_table

UPSTREAM = ("frames", "sweeps", "pano", "undistorted", "evidence")


def smoke(**changes: object) -> PaperRecipe:
    """`paper_smoke` with changes; its U-Net learns from a fifth of the columns, which take long to render."""
    recipe = preset("paper_smoke")
    assert isinstance(recipe, PaperRecipe)
    recipe = replace(recipe, refinement=replace(recipe.refinement, column_step=20))
    return replace(recipe, **changes)


def two_epochs(**changes: object) -> PaperRecipe:
    """Three frames are an epoch: the second one draws by the error map and in patches."""
    return smoke(optimiser=replace(smoke().optimiser, steps=6), **changes)


def entry(root: Path) -> SceneEntry:
    return SceneEntry(
        name="tiny", root=root, sequence=DEMO_SEQUENCE, first_frame=0, last_frame=3, test_frames=(2,)
    )


@pytest.fixture(scope="module")
def drive(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("paper") / "drive"
    write_demo(root, size=DemoSize.tiny())
    return root


@pytest.fixture(scope="module")
def home(drive) -> Path:
    """A home in which everything before `field` is published."""
    path = drive.parent / "home"
    run = plan_run(entry(drive), path, recipe=smoke())
    for stage in UPSTREAM:
        run_named_stage(stage, run, lambda line: None)
    return path


def train(drive: Path, home: Path, recipe: Recipe, said: list[str] | None = None) -> Path:
    run = plan_run(entry(drive), home, recipe=recipe)
    return run_named_stage("field", run, (said if said is not None else []).append).path


def test_every_stage_runs_with_the_papers_recipe(drive, home):
    outcomes = {
        one.stage: one for one in run_scene(entry(drive), home, recipe=smoke(), progress=lambda _: None)
    }
    rows = read_rows(outcomes["scene_metrics"].path / "metrics.parquet")
    model = [row for row in rows if row["recipe"] == "paper_smoke"]
    assert {row["protocol"] for row in model} >= {"lidar4d", "lidar4d_scan", "raw", "image"}
    panos = read_arrays(outcomes["novel_views"].path / "test" / "model.zarr", "pano_range_m", "pano_hit")
    assert panos["pano_range_m"].shape[1:] == (66, 1030)
    for method in ("paper_smoke", "reproject", "mesh"):
        named = [row for row in rows if (row["recipe"], row["metric"]) == (method, "image_depth_rmse_m")]
        depth = {row["protocol"]: row["value"] for row in named}
        # As published, zeros of all pixels without a return are in the mean.
        assert 0.0 < depth["lidar4d"] < depth["image"] < 80.0, method
    # Its own panos, thresholded: empty exactly where no return is expected.
    assert np.array_equal(panos["pano_range_m"] > 0, panos["pano_hit"] > 0.5)


def test_the_training_curve_shows_every_term(drive, home):
    recipe = smoke(
        name="all_terms",
        losses=PaperLosses(chamfer=1.0, flow_magnitude=1.0),
        optimiser=replace(smoke().optimiser, steps=12),
    )
    curve = read_table(train(drive, home, recipe) / "curve.parquet")
    named = ("flow", "depth", "intensity", "raydrop", "gradient", "colour")
    for term in (*named, "chamfer", "flow_magnitude"):
        assert any(value is not None and value >= 0.0 for value in curve[term]), term


def test_sweeps_of_a_model_that_learned_recorded_ranges_get_no_laser_error_twice(drive, home):
    train(drive, home, smoke())
    run = plan_run(entry(drive), home, recipe=smoke())
    task = Task(scene=run.scene, store=run.store, config=run.config, folder=home, progress=lambda _: None)
    recording = read_recording(run.store)
    model = load_model(task, recording)
    assert recording.lidar is not None and model.as_recorded
    table = recording.lidar.sweeps.table
    wrong = replace(table, range_bias_m=np.linspace(-0.5, 0.5, 64), intensity_gain=np.linspace(0.5, 2.0, 64))
    lidars = [
        replace(recording.lidar, sweeps=replace(recording.lidar.sweeps, table=each))
        for each in (table, wrong)
    ]
    views = [held_out_view(replace(recording, lidar=lidar), (2,)) for lidar in lidars]

    def made(rendered: SceneModel) -> list[dict[str, np.ndarray]]:
        both = zip(lidars, [view.sweeps for view in views], strict=True)
        return [
            sweep_arrays(task, lidar, plan, rendered, "model") | along_recorded_rays(lidar, plan, rendered)
            for lidar, plan in both
        ]

    even, uneven = made(model)
    # Points leave as the field, trained on panos as recorded, renders them: whatever the lasers' errors are.
    assert np.allclose(even["grid_range_m"], uneven["grid_range_m"], atol=1e-4)
    # Not to the bit: on an H200 two renderings differ by 6e-8.
    assert np.allclose(even["grid_intensity"], uneven["grid_intensity"], rtol=0.0, atol=1e-6)
    apart = np.abs(even["ray_intensity"] - uneven["ray_intensity"])
    assert apart.max() <= (1e-6 if torch.cuda.is_available() else 0.0)
    # What is compared with recorded ranges without their biases has none either.
    laser = recording.lidar.sweeps.arrays["laser"][recording.lidar.sweeps.returns_of(2)]
    taken_off = even["ray_range_m"] - uneven["ray_range_m"]
    assert np.allclose(taken_off, wrong.range_bias_m[laser], atol=1e-4)
    # A model of what is really there gets each laser's errors once, where the laser records.
    even, uneven = made(replace(model, as_recorded=False))
    assert np.abs(uneven["grid_range_m"] - even["grid_range_m"]).max() > 0.3
    assert np.array_equal(even["ray_range_m"], uneven["ray_range_m"])


def losses_of(recipe: PaperRecipe, recording: Recording, store: SceneStore, steps: int) -> list[float]:
    """All losses of the first steps (those of the flow are small), with draws alike for every recipe."""
    frames = training_frames(recipe, recording)
    # The tiny drive's lasers are too far apart for neighbouring pixels: a wavy wall takes the panos' place.
    columns = torch.arange(1030.0)
    wall_m = 8.0 + 3.0 * torch.sin(columns / 40.0) + 0.02 * torch.sin(columns * 1.7)
    panos = replace(frames.panos, range_m=wall_m.expand(frames.panos.range_m.shape))
    frames = replace(frames, panos=panos)
    trainee = PaperTrainee(recipe, frames, torch.Generator().manual_seed(0))
    optimiser = torch.optim.Adam(trainee.field.parameter_groups(recipe.optimiser))
    found = []
    for step in range(steps):
        draws = torch.Generator().manual_seed(step)
        parts = paper_step(trainee, frames, 0, step, draws)
        losses = [one.total for part in parts for one in part()]
        optimiser.zero_grad()
        torch.stack(losses).sum().backward()
        optimiser.step()
        found += [loss.item() for loss in losses]
    return found


SWITCHES = {
    "encoders same": {"encoders": "same"},
    "encoders fused": {"encoders": "separate_fused"},
    "no aggregation": {"aggregate": False},
    "no heuristic draws": {"sampling": replace(smoke().sampling, heuristic=False)},
    "no patches": {"sampling": replace(smoke().sampling, patches=None)},
    "no camera": {"sampling": replace(smoke().sampling, camera=False)},
    "single-gradient mask": {"gradient": replace(smoke().gradient, mask="single")},
    "threshold": {"gradient": replace(smoke().gradient, threshold_m=0.01)},
    "squared gradient loss": {"gradient": replace(smoke().gradient, norm="mse")},
    **{
        name: {"losses": replace(smoke().losses, **{name: 0.5})}
        for name in ("flow", "depth", "intensity", "raydrop", "gradient", "colour")
    },
    "chamfer": {"losses": replace(smoke().losses, chamfer=1.0)},
    "flow_magnitude": {"losses": replace(smoke().losses, flow_magnitude=1.0)},
    **{
        slip: {"slips": ReferenceQuirks(**{slip: 2.0 if slip == "bound" else True})}
        for slip in (one.name for one in fields(ReferenceQuirks))
    },
}


def test_each_switch_alone_changes_the_training_and_nothing_breaks(drive, home):
    # Three frames are an epoch: the second one draws by the error map and in patches.
    store = plan_run(entry(drive), home, recipe=smoke()).store
    recording = read_recording(store)
    plain = losses_of(smoke(), recording, store, 4)
    for name, change in SWITCHES.items():
        found = losses_of(smoke(name="switched", **change), recording, store, 4)
        assert np.isfinite(found).all() and found != plain, name


def test_every_camera_of_a_drive_is_trained_on(tmp_path):
    size = replace(DemoSize.tiny(), cameras=("image_00", "image_01"), fisheye_side=64)
    write_demo(tmp_path / "drive", size=size)
    run = plan_run(entry(tmp_path / "drive"), tmp_path / "home", recipe=smoke())
    for stage in UPSTREAM:
        run_named_stage(stage, run, lambda line: None)
    recording = read_recording(run.store)
    frames = training_frames(smoke(), recording)
    assert [camera.name for camera in frames.cameras] == ["image_00", "image_01", "image_02"]
    trainee = PaperTrainee(smoke(), frames, torch.Generator().manual_seed(0))
    draws = torch.Generator().manual_seed(0)
    for camera in frames.cameras:
        (row,) = np.flatnonzero(camera.frame == frames.frames[0])
        # An even epoch, then one that draws by the error map.
        for epoch in (0, 1):
            for part in camera_losses(trainee, frames, camera, int(row), epoch, draws):
                part.total.backward()
        errors = trainee.image_errors[camera.name].errors
        assert errors[row].max() > 1.0, "the map has learned from its own camera"
    encoder = trainee.field.encoders[1]
    assert all(bool(p.grad.isfinite().all()) for p in encoder.parameters() if p.grad is not None)


@pytest.mark.parametrize("encoders", ["same", "separate_fused"])
def test_each_way_of_encoding_trains(drive, home, encoders):
    tensors, _ = load_tensors(
        train(drive, home, two_epochs(name=encoders, encoders=encoders)) / "weights.safetensors"
    )
    assert all(bool(torch.isfinite(value).all()) for value in tensors.values())


def test_the_authors_slips_train(drive, home):
    slips = ReferenceQuirks(
        flow_unit=True, neighbour_times=True, bound=2.0, minmax_box=True, half_precision_truth=True,
        recorded_elevations=True, identical_tables=True,
    )  # fmt: skip
    _, facts = load_tensors(train(drive, home, two_epochs(name="slips", slips=slips)) / "weights.safetensors")
    assert facts["bound"] == 2.0


def test_lidar_rays_alone_build_nothing_of_the_camera(drive, home):
    recipe = two_epochs(name="alone", sampling=replace(smoke().sampling, camera=False))
    tensors, _ = load_tensors(train(drive, home, recipe) / "weights.safetensors")
    both, _ = load_tensors(train(drive, home, smoke()) / "weights.safetensors")
    assert not any("colour" in name for name in tensors)
    assert sum("encoders" in name for name in both) == 2 * sum("encoders" in name for name in tensors)
    run = plan_run(entry(drive), home, recipe=recipe)
    task = Task(scene=run.scene, store=run.store, config=run.config, folder=home, progress=lambda _: None)
    assert load_model(task, read_recording(run.store)).camera is None


def test_every_whole_epoch_enters_the_average(drive, home):
    recipe = smoke(
        optimiser=replace(smoke().optimiser, steps=3), refinement=replace(smoke().refinement, channels=0)
    )
    run = plan_run(entry(drive), home, recipe=recipe)
    task = Task(scene=run.scene, store=run.store, config=run.config, folder=home, progress=lambda _: None)
    recording = read_recording(run.store)
    frames = training_frames(recipe, recording)
    assert len(frames.frames) == recipe.optimiser.steps
    work = run.store.work_dir("field/one_epoch/0")
    found = train_on_frames(recipe, recording, frames, StageSession(task, work)).tensors
    last, _ = load_tensors(work / "field.safetensors")
    start = PaperTrainee(recipe, frames, torch.Generator().manual_seed(0)).field
    # The first update: d_1 = min(0.95, 2 / 11) of the weights before training is kept.
    for name, before in start.named_parameters():
        expected = 2 / 11 * before.detach() + 9 / 11 * last[f"model.field.{name}"]
        assert torch.allclose(found[f"field.{name}"], expected, atol=1e-6), name


@pytest.mark.skipif(torch.cuda.is_available(), reason="a GPU adds gradients up in any order")
def test_a_stopped_training_ends_with_the_same_bits(drive, home):
    recipe = two_epochs(name="stopped")
    run = plan_run(entry(drive), home, recipe=recipe)

    class Stopped(Exception):
        pass

    def stop_at(step: str):
        def say(line: str) -> None:
            if step in line:
                raise Stopped

        return say

    whole, _ = load_tensors(train(drive, home, replace(recipe, name="whole")) / "weights.safetensors")
    # Once while rays are trained on (every checkpoint is kept), once between the phases.
    checkpoint = run.store.work_dir("field/stopped/0") / "field.safetensors"
    with pytest.raises(Stopped):
        run_named_stage(
            "field", plan_run(entry(drive), home, recipe=recipe), stop_at("rendered for the U-Net")
        )
    assert load_tensors(checkpoint)[1]["step"] == 6
    said: list[str] = []
    again, _ = load_tensors(train(drive, home, recipe, said) / "weights.safetensors")
    assert any("resumed from the checkpoint at step 6" in line for line in said)
    assert whole.keys() == again.keys()
    assert all(torch.equal(whole[name], again[name]) for name in whole)


def test_panos_are_learned_along_the_rays_that_sweeps_are_rendered_along(drive, home):
    """Both are turned up by the angle by which the sensor's recorded elevations are too low."""
    recording = read_recording(plan_run(entry(drive), home, recipe=smoke()).store)
    assert recording.lidar is not None
    panos, sweeps = training_frames(smoke(), recording).panos, recording.lidar.sweeps
    assert panos is not None
    scan = int(np.flatnonzero(sweeps.is_training)[0])
    part, a = sweeps.returns_of(scan), sweeps.arrays
    row, column, _, kept = LinearPano().cells(a["points_m"][part])
    returned_m = a["origin_m"][part] + a["direction"][part] * a["range_m"][part][:, None]
    seen_m = ((returned_m - panos.pose[0][:3, 3]) @ panos.pose[0][:3, :3])[kept]
    learned = LinearPano().directions(panos.turn_up_rad)[row[kept], column[kept]]
    higher_rad = np.arctan2(seen_m[:, 2], np.hypot(*seen_m[:, :2].T)) - np.arcsin(learned[:, 2])
    assert abs(float(np.mean(higher_rad))) < 0.3 * panos.turn_up_rad
