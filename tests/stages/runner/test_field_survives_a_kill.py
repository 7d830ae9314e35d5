"""A training that is killed in each of its phases goes on every time, and ends where it would have ended."""

import multiprocessing
import os
import shutil
import signal
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from nvsf_core.demo.drive import DEMO_SEQUENCE, DemoSize, write_demo
from nvsf_core.drives.catalogue import SceneEntry
from nvsf_core.models.residual import lidar as residual_training
from nvsf_core.recipe.base import Recipe
from nvsf_core.recipe.presets import preset
from nvsf_core.recipe.residual import FieldSpec, HitsSpec, PanoSpec, TrainingSpec
from nvsf_core.stages import plan_run, run_named_stage
from nvsf_core.stages.runner import checkpoints
from nvsf_core.stores.checkpoints import load_tensors

UPSTREAM = ("frames", "sweeps", "pano", "undistorted", "evidence")
FRAMES = 7
"""Just enough for scans that judge what is learned from the others."""
STEPS = 6
"""Of each phase. A checkpoint is due at every one of them."""
KILLED_AFTER = 4
_TRAINING = TrainingSpec(steps=STEPS, rays=512, checkpoint_s=0.0)
RESIDUAL = replace(
    preset("smoke"),
    name="often_saved",
    lidar_field=FieldSpec(levels=2, log2_table=8),
    lidar_training=replace(_TRAINING, rays=64),
    depth_training=_TRAINING,
    hits=HitsSpec(channels=4, layers=1, training=replace(_TRAINING, rays=64)),
    pano=PanoSpec(phases=1, parts=2, channels=4, layers=1, training=replace(_TRAINING, rays=264)),
)
PAPER = preset("paper_smoke")
PAPER = replace(
    PAPER,
    name="often_saved_paper",
    # Whole epochs of the six training frames: the average of the last one is taken after the last step.
    optimiser=replace(PAPER.optimiser, steps=STEPS),
    refinement=replace(PAPER.refinement, steps=STEPS, panos=1, column_step=8),
)
PHASES = {"lidar": "lidar.", "hits": "hits.", "pano": "pano.", "depth": "depth_maps."}
"""Of the residual recipes, in their order, and how the names of what they learn begin."""
PAPER_PHASES = {"field": "field.", "refinement": "unet."}
"""LiDAR and camera rays train the paper's field together."""


def run_of(root: Path, home: Path, recipe: Recipe):
    scene = SceneEntry(
        name="tiny",
        root=root,
        sequence=DEMO_SEQUENCE,
        first_frame=0,
        last_frame=FRAMES - 1,
        test_frames=(2,),
    )
    return plan_run(scene, home, recipe=recipe)


def train(root: Path, home: Path, recipe: Recipe, phase: str = "") -> None:
    """Train in a process of its own; what it says is in `said.txt`.

    With a phase, SIGKILL ends the process as it is about to save what that was past the given step. By its
    own hand, for a killer outside must guess at the time.
    """
    save = checkpoints.save_tensors

    def save_or_die(path: Path, tensors: Mapping[str, torch.Tensor], facts: Mapping[str, object]) -> None:
        if path.stem == phase and facts["step"] == KILLED_AFTER + 1:
            os.kill(os.getpid(), signal.SIGKILL)
        save(path, tensors, facts)

    checkpoints.save_tensors = save_or_die
    # A field of six steps loses, and nothing would be learned of what it shows.
    residual_training.choose = lambda *_: (True, {"lidar_shows": "field"})
    with (home / "said.txt").open("w") as said:
        run_named_stage("field", run_of(root, home, recipe), lambda line: print(line, file=said))


def exit_code_of(*arguments: object) -> int | None:
    """Of a process that calls `train`. All share one server: it loads the libraries and the code once."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["nvsf_core.stages.field"])
    child = context.Process(target=train, args=arguments)
    child.start()
    child.join()
    return child.exitcode


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a drive, and with two homes of all that a training reads."""
    folder = tmp_path_factory.mktemp("killed")
    write_demo(folder / "drive", size=replace(DemoSize.tiny(), frames=FRAMES))
    for stage in UPSTREAM:
        run_named_stage(stage, run_of(folder / "drive", folder / "whole", RESIDUAL), lambda line: None)
    shutil.copytree(folder / "whole", folder / "killed")
    return folder


@pytest.mark.parametrize(
    ("recipe", "phases"), [(RESIDUAL, PHASES), (PAPER, PAPER_PHASES)], ids=["residual", "paper"]
)
def test_a_training_killed_in_every_phase_ends_with_the_same_weights(
    prepared: Path, recipe: Recipe, phases: Mapping[str, str]
) -> None:
    root, home, location = prepared / "drive", prepared / "killed", f"field/{recipe.name}/0"
    work = home / "tiny" / ".work" / location
    for phase in phases:
        assert exit_code_of(root, home, recipe, phase) == -signal.SIGKILL
        assert load_tensors(work / f"{phase}.safetensors")[1]["step"] == KILLED_AFTER
        assert not (home / "tiny" / location).exists()
    assert exit_code_of(root, home, recipe) == exit_code_of(root, prepared / "whole", recipe) == 0

    resumed_line = f"[tiny] field, {list(phases)[-1]}: resumed from the checkpoint at step {KILLED_AFTER}"
    assert resumed_line in (home / "said.txt").read_text().splitlines()
    unbroken, _ = load_tensors(prepared / "whole" / "tiny" / location / "weights.safetensors")
    resumed, _ = load_tensors(home / "tiny" / location / "weights.safetensors")
    assert all(any(name.startswith(weights) for name in unbroken) for weights in phases.values())
    assert set(unbroken) == set(resumed)
    assert [name for name in unbroken if not torch.equal(unbroken[name], resumed[name])] == []
