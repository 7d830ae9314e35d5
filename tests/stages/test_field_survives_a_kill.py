"""A training that is killed goes on from its checkpoint, and ends where it would have ended."""

import multiprocessing
import os
import shutil
import signal
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from nvsf_core.kitti360.catalogue import SceneEntry
from nvsf_core.kitti360.demo import DEMO_SEQUENCE, DemoSize, write_demo
from nvsf_core.recipe import FieldSpec, PanoSpec, Recipe, TrainingSpec, preset
from nvsf_core.stages import plan_run, run_named_stage
from nvsf_core.stores.checkpoints import load_tensors

UPSTREAM = ("frames", "sweeps", "pano", "undistorted", "evidence")
STEPS = 300
PAPER_STEPS = 40
_GRID = FieldSpec(levels=2, log2_table=8)
SLOW = replace(
    preset("smoke"),
    name="slow",
    lidar_field=_GRID,
    lidar_training=TrainingSpec(steps=STEPS, rays=64, checkpoint_s=0.0, threads=1),
    depth_training=TrainingSpec(steps=5, rays=512, checkpoint_s=0.0, threads=1),
    camera_training=TrainingSpec(steps=5, rays=512, checkpoint_s=0.0, threads=1),
    pano=PanoSpec(
        phases=1, parts=2, channels=4, layers=1,
        training=TrainingSpec(steps=STEPS, rays=264, checkpoint_s=0.0, threads=1),
    ),
)  # fmt: skip

PAPER = preset("paper_smoke")
PAPER = replace(
    PAPER,
    name="slow_paper",
    optimiser=replace(PAPER.optimiser, steps=PAPER_STEPS),
    refinement=replace(PAPER.refinement, channels=0),
)
CASES = [(SLOW, "lidar", STEPS), (SLOW, "pano", STEPS), (PAPER, "field", PAPER_STEPS)]


def run_of(root: Path, home: Path, recipe: Recipe = SLOW):
    scene = SceneEntry(
        name="tiny", root=root, sequence=DEMO_SEQUENCE, first_frame=0, last_frame=3, test_frames=(2,)
    )
    return plan_run(scene, home, recipe=recipe)


def train_field(root: Path, home: Path, recipe: Recipe) -> None:
    run_named_stage("field", run_of(root, home, recipe), lambda line: None)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """A folder with a drive, and with its fields trained without a break."""
    folder = tmp_path_factory.mktemp("killed")
    write_demo(folder / "drive", size=DemoSize.tiny())
    for stage in UPSTREAM:
        run_named_stage(stage, run_of(folder / "drive", folder / "whole"), lambda line: None)
    for _, part, _ in CASES:
        shutil.copytree(folder / "whole", folder / part)
    for recipe in (SLOW, PAPER):
        train_field(folder / "drive", folder / "whole", recipe)
    return folder


@pytest.mark.parametrize(("recipe", "part", "steps"), CASES, ids=[part for _, part, _ in CASES])
def test_a_killed_field_resumes_and_ends_with_the_same_weights(
    whole: Path, recipe: Recipe, part: str, steps: int
) -> None:
    root, home, location = whole / "drive", whole / part, f"field/{recipe.name}/0"
    checkpoint = home / "tiny" / ".work" / location / f"{part}.safetensors"
    child = multiprocessing.get_context("spawn").Process(target=train_field, args=(root, home, recipe))
    child.start()
    deadline = time.monotonic() + 300.0
    while not checkpoint.is_file() and time.monotonic() < deadline:
        time.sleep(0.002)
    os.kill(child.pid, signal.SIGKILL)
    child.join()
    _, facts = load_tensors(checkpoint)
    assert 0 < facts["step"] < steps
    assert not (home / "tiny" / location).exists()

    said: list[str] = []
    run_named_stage("field", run_of(root, home, recipe), said.append)
    assert any(f"{part}: resumed from the checkpoint at step {facts['step']}" in line for line in said)
    unbroken, _ = load_tensors(whole / "whole" / "tiny" / location / "weights.safetensors")
    resumed, _ = load_tensors(home / "tiny" / location / "weights.safetensors")
    assert any(name.startswith(f"{part}.") for name in unbroken)
    assert all(torch.equal(unbroken[name], resumed[name]) for name in unbroken)
