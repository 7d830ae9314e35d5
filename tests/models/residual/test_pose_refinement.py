"""A drive whose recorded poses err, through the real stages: images are aligned, and views go with them."""

import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nvsf_core.demo.drive import DemoSize
from nvsf_core.geometry.se3 import exp_se3, pose_from_parts
from nvsf_core.models.residual.camera import ALIGNED, train_camera
from nvsf_core.models.residual.dynamic_masks import MovingWorld
from nvsf_core.models.residual.pose_refinement import align_drive, aligned_by, facts_of, from_facts
from nvsf_core.recipe.presets import preset
from nvsf_core.recording.drive import Recording
from nvsf_core.rendering.image_alignment import PoseCorrection, align_images
from nvsf_core.stages import SceneRun
from nvsf_core.stages.inputs import read_recording
from nvsf_core.stages.runner.checkpoints import StageSession
from nvsf_core.stages.runner.stage import Task
from tests.models.residual.conftest import Prepare

FRAMES = 6
CAMERA = "image_00"
SIZE = DemoSize(
    frames=FRAMES, lasers=tuple(range(0, 64, 2)), firings=700, cameras=(CAMERA,), width=192, height=96,
    fisheye_side=0,
)  # fmt: skip
JUDGE = 2


@pytest.fixture(scope="module")
def run(prepare: Prepare) -> SceneRun:
    """The demo as far as training reads it."""
    return prepare("aligned", SIZE)


@pytest.fixture(scope="module")
def drive(run: SceneRun) -> Recording:
    """With poses of images that are told slightly wrong, each otherwise."""
    recording = read_recording(run.store)
    errors = np.random.default_rng(0).normal(size=(FRAMES, 6)) * [0.01, 0.01, 0.01, 0.003, 0.003, 0.003]
    pose = recording.cameras[CAMERA].training.pose
    return _with_images(recording, pose=pose @ exp_se3(errors))


def _with_images(recording: Recording, **changed: np.ndarray) -> Recording:
    one = recording.cameras[CAMERA]
    return replace(recording, cameras={CAMERA: replace(one, training=replace(one.training, **changed))})


def _constant(drive: Recording, twist: np.ndarray) -> dict[str, dict[str, object]]:
    time_s = drive.cameras[CAMERA].training_time_s
    return {CAMERA: {"time_s": time_s.tolist(), "twist": np.tile(twist, (len(time_s), 1)).tolist()}}


def test_what_is_known_of_poses_survives_a_file_and_moves_images_and_views_alike(drive: Recording) -> None:
    world = MovingWorld(drive)
    aligned = aligned_by(world, align_drive(world, [CAMERA]))
    known = from_facts(PoseCorrection, json.loads(json.dumps(facts_of(aligned.corrections))))
    again = aligned_by(world, known)
    given, moved = drive.cameras[CAMERA].training.pose, aligned.world.recording.cameras[CAMERA].training.pose
    assert np.abs(moved - given).max() > 1e-3
    assert np.array_equal(again.world.recording.cameras[CAMERA].training.pose, moved)
    assert np.array_equal(aligned.given.cameras[CAMERA].training.pose, given)
    constant = aligned_by(world, from_facts(PoseCorrection, _constant(drive, np.full(6, 0.003))))
    expected = given[2] @ exp_se3(np.full(6, 0.003))
    assert constant.left_out_pose(CAMERA, 2) == pytest.approx(expected)


def _recorded(drive: Recording, time_s: float) -> np.ndarray:
    """Where the camera was, by the trajectory."""
    rotation, position = drive.trajectory.at(np.array([time_s]))
    recorded: np.ndarray = pose_from_parts(rotation[0], position[0]) @ drive.cameras[CAMERA].in_lidar
    return recorded


def test_a_view_that_looks_elsewhere_goes_with_the_camera_that_recorded(drive: Recording) -> None:
    twist = np.array([0.02, -0.01, 0.03, 0.004, -0.002, 0.001])
    aligned = aligned_by(MovingWorld(drive), from_facts(PoseCorrection, _constant(drive, twist)))
    backwards = exp_se3(np.array([0.0, 0.0, 0.0, 0.0, np.pi, 0.0]))
    aside = exp_se3(np.array([1.0, -0.5, 2.0, 0.0, 0.0, 0.3]))
    for time_s in (0.0, 0.23):
        recorded = _recorded(drive, time_s)
        there = aligned.pose_at(CAMERA, recorded, time_s)
        np.testing.assert_allclose(there, recorded @ exp_se3(twist), rtol=0.0, atol=1e-12)
        for place in (backwards, aside):
            moved = aligned.pose_at(CAMERA, recorded @ place, time_s)
            np.testing.assert_allclose(np.linalg.inv(there) @ moved, place, rtol=0.0, atol=1e-9)


def test_an_image_that_was_taken_long_after_the_last_frame_is_corrected_too(drive: Recording) -> None:
    twist = np.array([0.02, -0.01, 0.03, 0.004, -0.002, 0.001])
    aligned = aligned_by(MovingWorld(drive), from_facts(PoseCorrection, _constant(drive, twist)))
    end_s = float(drive.trajectory.times_s[-1])
    recorded = _recorded(drive, end_s)
    there = aligned.pose_at(CAMERA, recorded, end_s + 0.3)
    np.testing.assert_allclose(there, recorded @ exp_se3(twist), rtol=0.0, atol=1e-12)


def test_a_camera_that_nobody_aligned_and_a_drive_without_lidar_keep_their_poses(drive: Recording) -> None:
    pose = drive.cameras[CAMERA].training.pose[1]
    blind = MovingWorld(replace(drive, lidar=None))
    for world, cameras in ((MovingWorld(drive), []), (blind, [CAMERA])):
        kept = aligned_by(world, align_drive(world, cameras))
        assert facts_of(kept.corrections) == {}
        assert kept.pose_at(CAMERA, pose, 0.1) is pose
        assert np.array_equal(kept.left_out_pose(CAMERA, 1), pose)


def test_nothing_of_a_silent_image_is_in_any_pose_that_it_is_judged_with(drive: Recording) -> None:
    images = drive.cameras[CAMERA].training.rgb.copy()
    images[JUDGE] = np.roll(images[JUDGE], 5, axis=1)
    found = []
    for recording in (drive, _with_images(drive, rgb=images)):
        world = MovingWorld(recording)
        for silent in ({CAMERA: [JUDGE]}, None):
            aligned = aligned_by(world, align_drive(world, [CAMERA], silent))
            pose = aligned.world.recording.cameras[CAMERA].training.pose
            found.append(np.concatenate([pose, aligned.left_out_pose(CAMERA, JUDGE)[None]]))
            if silent:
                assert np.array_equal(pose[JUDGE], aligned.left_out_pose(CAMERA, JUDGE))
                assert not np.array_equal(pose[JUDGE], recording.cameras[CAMERA].training.pose[JUDGE])
    told, heard, told_other, heard_other = found
    assert np.array_equal(told, told_other)
    assert not np.array_equal(np.delete(heard, JUDGE, 0), np.delete(heard_other, JUDGE, 0))


def test_an_image_whose_scan_is_missing_borrows_none(drive: Recording) -> None:
    assert drive.lidar is not None
    images, time_s = drive.cameras[CAMERA].training, drive.cameras[CAMERA].training_time_s
    is_training = drive.lidar.sweeps.is_training.copy()
    is_training[3] = False
    sweeps = replace(drive.lidar.sweeps, is_training=is_training)
    missing = replace(drive, lidar=replace(drive.lidar, sweeps=sweeps))
    returns_m = [MovingWorld(drive).static_points(instant_s, most=1) for instant_s in time_s.tolist()]
    assert len(returns_m[3])
    returns_m[3] = returns_m[3][:0]
    expected = align_images(images.rgb, images.pinhole, images.pose, returns_m)
    found = align_drive(MovingWorld(missing), [CAMERA])[CAMERA].twist
    assert expected.any() and np.array_equal(found, expected)


def test_the_seconds_of_training_the_camera_are_all_that_it_took(
    run: SceneRun, drive: Recording, tmp_path: Path
) -> None:
    once = replace(preset("smoke").depth_training, steps=1)
    camera = replace(preset("smoke").camera, aligned=True)
    recipe = replace(preset("smoke"), depth_training=once, camera=camera)
    task = Task(scene=run.scene, store=run.store, config=replace(run.config, recipe=recipe), folder=tmp_path,
                progress=lambda _: None)  # fmt: skip
    started = time.perf_counter()
    trained = train_camera(StageSession(task, tmp_path), recipe, drive)
    took_s = time.perf_counter() - started
    assert f"{CAMERA}_judged_aligned_gain_db" in trained.metadata
    counted_s = trained.preparation_seconds + sum(state.seconds for state in trained.states.values())
    assert 0.85 * took_s < counted_s <= took_s
    for known in from_facts(PoseCorrection, trained.facts[ALIGNED]).values():
        assert np.array_equal(known.time_s, drive.cameras[CAMERA].training_time_s)
