"""A drive whose recorded poses err, through the real stages: images are aligned, and views go with them."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nvsf_core.geometry.se3 import exp_se3
from nvsf_core.kitti360.catalogue import SceneEntry
from nvsf_core.kitti360.demo import DEMO_SEQUENCE, DemoSize, write_demo
from nvsf_core.recipe import preset
from nvsf_core.stages import plan_run, run_named_stage
from nvsf_core.stages.aligned_drive import align_drive, aligned_by, corrections_from, facts_of
from nvsf_core.stages.recording import Recording, read_recording

FRAMES = 6
CAMERA = "image_00"
SIZE = DemoSize(
    frames=FRAMES, lasers=tuple(range(0, 64, 2)), firings=700, cameras=(CAMERA,), width=192, height=96,
    fisheye_side=0,
)  # fmt: skip


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    folder: Path = tmp_path_factory.mktemp("aligned")
    write_demo(folder / "drive", size=SIZE)
    scene = SceneEntry(
        name="aligned", root=folder / "drive", sequence=DEMO_SEQUENCE, first_frame=0, last_frame=FRAMES - 1,
        test_frames=(),
        sweep_period_s=0.1,
    )  # fmt: skip
    run = plan_run(scene, folder / "home", recipe=preset("smoke"))
    for stage in ("frames", "sweeps", "undistorted", "evidence"):
        run_named_stage(stage, run, lambda _: None)
    return read_recording(run.store)


def test_what_is_known_of_poses_survives_a_file_and_moves_images_and_views_alike(drive: Recording) -> None:
    aligned = align_drive(drive, [CAMERA])
    known = corrections_from(json.loads(json.dumps(facts_of(aligned.corrections))))
    again = aligned_by(drive, known)
    given, moved = drive.cameras[CAMERA].training.pose, aligned.world.recording.cameras[CAMERA].training.pose
    assert np.array_equal(again.world.recording.cameras[CAMERA].training.pose, moved)
    assert np.array_equal(aligned.given.cameras[CAMERA].training.pose, given)
    constant = aligned_by(
        drive, {CAMERA: replace(known[CAMERA], twist=np.tile(np.full(6, 0.003), (len(given), 1)))}
    )
    expected = given[2] @ exp_se3(np.full(6, 0.003))
    assert constant.left_out_pose(CAMERA, 2) == pytest.approx(expected)
    assert constant.pose_at(CAMERA, given[2], 0.17) == pytest.approx(expected)


def test_a_camera_that_nobody_aligned_and_a_drive_without_lidar_keep_their_poses(drive: Recording) -> None:
    pose = drive.cameras[CAMERA].training.pose[1]
    for kept in (align_drive(drive, []), align_drive(replace(drive, lidar=None), [CAMERA])):
        assert facts_of(kept.corrections) == {}
        assert kept.pose_at(CAMERA, pose, 0.1) is pose
        assert np.array_equal(kept.left_out_pose(CAMERA, 1), pose)
