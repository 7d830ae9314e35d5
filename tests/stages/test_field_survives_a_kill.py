"""A training that is killed goes on from its checkpoint, and ends where it would have ended."""

import multiprocessing
import os
import signal
import time
from dataclasses import replace
from pathlib import Path

import torch

from nvsf_core.kitti360.catalogue import SceneEntry
from nvsf_core.kitti360.demo import DEMO_SEQUENCE, DemoSize, write_demo
from nvsf_core.recipe import FieldSpec, TrainingSpec, preset
from nvsf_core.stages import plan_run, run_named_stage
from nvsf_core.stores.checkpoints import load_tensors

UPSTREAM = ("frames", "sweeps", "pano", "undistorted", "evidence")
LOCATION = "field/slow/0"
_GRID = FieldSpec(levels=2, log2_table=8)
SLOW = replace(
    preset("smoke"),
    name="slow",
    lidar_field=_GRID,
    lidar_training=TrainingSpec(steps=300, rays=64, checkpoint_s=0.0, threads=1),
    depth_training=TrainingSpec(steps=5, rays=512, checkpoint_s=0.0, threads=1),
    camera_training=TrainingSpec(steps=5, rays=512, checkpoint_s=0.0, threads=1),
)


def run_of(root: Path, home: Path):
    scene = SceneEntry(
        name="tiny", root=root, sequence=DEMO_SEQUENCE, first_frame=0, last_frame=3, test_frames=(2,)
    )
    return plan_run(scene, home, recipe=SLOW)


def train_field(root: Path, home: Path) -> None:
    run_named_stage("field", run_of(root, home), lambda line: None)


def test_a_killed_field_resumes_and_ends_with_the_same_weights(tmp_path) -> None:
    root = tmp_path / "drive"
    write_demo(root, size=DemoSize.tiny())
    for home in ("whole", "killed"):
        for stage in UPSTREAM:
            run_named_stage(stage, run_of(root, tmp_path / home), lambda line: None)
    train_field(root, tmp_path / "whole")

    checkpoint = tmp_path / "killed" / "tiny" / ".work" / LOCATION / "lidar.safetensors"
    child = multiprocessing.get_context("spawn").Process(target=train_field, args=(root, tmp_path / "killed"))
    child.start()
    deadline = time.monotonic() + 60.0
    while not checkpoint.is_file() and time.monotonic() < deadline:
        time.sleep(0.002)
    os.kill(child.pid, signal.SIGKILL)
    child.join()
    _, facts = load_tensors(checkpoint)
    assert 0 < facts["step"] < SLOW.lidar_training.steps
    assert not (tmp_path / "killed" / "tiny" / LOCATION).exists()

    said: list[str] = []
    run_named_stage("field", run_of(root, tmp_path / "killed"), said.append)
    assert any(f"resumed from the checkpoint at step {facts['step']}" in line for line in said)
    whole, _ = load_tensors(tmp_path / "whole" / "tiny" / LOCATION / "weights.safetensors")
    killed, _ = load_tensors(tmp_path / "killed" / "tiny" / LOCATION / "weights.safetensors")
    assert all(torch.equal(whole[name], killed[name]) for name in whole)
