"""Images that were taken at times of their own: they are shown where they were taken."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nvsf_core.drives.entries import SceneEntry
from nvsf_core.drives.plain.layout import PlainLayout
from nvsf_core.drives.plain.writer import (
    write_cameras,
    write_description,
    write_frame_times,
    write_image_times,
    write_plain_image,
    write_poses,
)
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.geometry.se3 import pose_of_angles
from nvsf_core.models.baselines.reproject import depth_scans
from nvsf_core.recipe.presets import preset
from nvsf_core.recipe.residual import TrainingSpec
from nvsf_core.recording.drive import Recording, Sweeps
from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.sensors.tables import HDL_64E
from nvsf_core.stages import plan_run, run_named_stage
from nvsf_core.stages.imports.convert import import_drive
from nvsf_core.stages.inputs import read_recording
from nvsf_core.stages.views.view import held_out_view
from nvsf_core.stores.arrays import read_arrays
from nvsf_core.stores.tables import read_rows

FRAMES, TEST, PERIOD_S = 10, (6, 7, 9), 0.1
DELAY_S = 0.025
CAMERA = Pinhole(fx=20.0, fy=20.0, cx=15.5, cy=11.5, width=32, height=24)
MOUNTING = np.array([[0.0, 0.0, 1.0, 0.3], [-1.0, 0.0, 0.0, 0.1], [0.0, -1.0, 0.0, -0.2], [0, 0, 0, 1]])


def place(time_s: float) -> np.ndarray:
    """The LiDAR's pose: it drives 15 m/s, and after .4 s 5 m/s."""
    pose = np.eye(4)
    pose[0, 3] = 15.0 * min(time_s, 0.4) + 5.0 * max(time_s - 0.4, 0.0)
    return pose


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> SceneEntry:
    """A plain drive of one camera, whose images are later than their frames, each by another delay."""
    layout = PlainLayout(tmp_path_factory.mktemp("times") / "drive")
    write_description(layout, "VLP-16")
    moments = np.arange(FRAMES) * PERIOD_S
    write_poses(layout, range(FRAMES), moments.tolist(), [place(one) for one in moments])
    write_cameras(layout, {"front": (CAMERA, MOUNTING)})
    rng = np.random.default_rng(0)
    for frame in range(FRAMES):
        write_plain_image(layout, "front", frame, rng.integers(0, 255, (24, 32, 3), np.uint8))
    write_image_times(
        layout, "front", {frame: frame * PERIOD_S + (1 + frame % 2) * DELAY_S for frame in range(FRAMES - 1)}
    )
    return SceneEntry(
        name="times", root=layout.root, sequence="there", kind="plain", first_frame=0, last_frame=FRAMES - 1,
        test_frames=TEST,
    )  # fmt: skip


@pytest.fixture(scope="module")
def recording(scene: SceneEntry, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    run = plan_run(scene, tmp_path_factory.mktemp("home"), recipe="smoke")
    for stage in ("frames", "sweeps", "undistorted", "evidence"):
        run_named_stage(stage, run, lambda line: None)
    return read_recording(run.store)


def test_the_mounting_has_none_of_the_cars_motion_in_it(recording: Recording) -> None:
    np.testing.assert_allclose(recording.cameras["front"].in_lidar, MOUNTING, atol=1e-9)


def test_images_have_their_own_times(recording: Recording) -> None:
    camera = recording.cameras["front"]
    own_s = [k * PERIOD_S + (1 + k % 2) * DELAY_S for k in range(FRAMES - 1)]
    # The last one has no time, and is left out.
    np.testing.assert_allclose(camera.recorded_time_s, own_s, atol=1e-9)
    trained = [frame for frame in range(FRAMES) if frame not in TEST]
    assert camera.training_frame.tolist() == trained
    np.testing.assert_allclose(camera.training_time_s, camera.recorded_time_s[trained], atol=1e-9)


def test_the_scan_of_an_images_frame_is_left_out_however_late_the_image_is() -> None:
    path = Trajectory(np.arange(9) * PERIOD_S, np.tile(np.eye(4), (9, 1, 1)), np.eye(4))
    arrays = {"frame": 10 + np.arange(9), "time_s": np.arange(9) * PERIOD_S}
    sweeps = Sweeps(arrays, np.ones(9, bool), path, PERIOD_S, HDL_64E, 0.0)
    for delay_s in (0.0, 0.045, 0.055, 0.065):
        assert depth_scans(sweeps, 5 * PERIOD_S + delay_s)[0] == (5 if delay_s < 0.05 else 6)
        found = depth_scans(sweeps, 5 * PERIOD_S + delay_s, leave_out=15)
        assert sorted(found) == [0, 1, 2, 3, 4, 6, 7, 8], delay_s


def test_held_out_images_are_shown_where_and_when_they_were_taken(recording: Recording) -> None:
    view = held_out_view(recording, TEST)
    assert view is not None
    plan = view.images["front"]
    assert plan.frame.tolist() == [6, 7]
    taken_s = [6 * PERIOD_S + DELAY_S, 7 * PERIOD_S + 2 * DELAY_S]
    np.testing.assert_allclose(plan.time_s, taken_s, atol=1e-9, err_msg="of what moves")
    np.testing.assert_allclose(plan.moments_s, taken_s, atol=1e-9, err_msg="of the camera")
    path = recording.trajectory
    shown = path.scene_to_world @ (plan.poses(path) @ recording.cameras["front"].in_lidar)
    np.testing.assert_allclose(shown, [place(one) @ MOUNTING for one in taken_s], atol=1e-6)


def test_held_out_images_have_the_poses_that_the_drive_gives_them_wherever_these_lie(tmp_path: Path) -> None:
    layout, last_s = PlainLayout(tmp_path / "drive"), (FRAMES - 1) * PERIOD_S
    write_description(layout, "VLP-16")
    write_cameras(layout, {"front": (CAMERA, MOUNTING)})
    write_frame_times(layout, {frame: frame * PERIOD_S for frame in range(FRAMES)})
    # Five poses from frame to frame, in which the car sways to and fro; they end 0.2 s after the last frame.
    pose_s = np.arange(5 * (FRAMES + 1) + 1) * PERIOD_S / 5
    sways = [pose_of_angles((9.0 * one, np.sin(40.0 * one), 0.0), 3.0, 0.0, 0.0) for one in pose_s]
    write_poses(layout, None, pose_s.tolist(), sways)
    image_s = {frame: frame * PERIOD_S + 0.04 for frame in range(FRAMES - 2)}
    image_s |= {FRAMES - 2: last_s + 0.16, FRAMES - 1: last_s + 0.31}
    write_image_times(layout, "front", image_s)
    rng = np.random.default_rng(0)
    for frame in range(FRAMES):
        write_plain_image(layout, "front", frame, rng.integers(0, 255, (24, 32, 3), np.uint8))
    scene = SceneEntry(
        name="late", root=layout.root, sequence="there", kind="plain", first_frame=0, last_frame=FRAMES - 1,
        test_frames=(3, FRAMES - 2, FRAMES - 1),
    )  # fmt: skip
    recipe = replace(preset("smoke"), depth_training=TrainingSpec(steps=20, rays=512))
    run = plan_run(scene, tmp_path / "home", recipe=recipe)
    for stage in ("frames", "sweeps", "undistorted", "pano", "evidence", "mesh", "field", "novel_views"):
        outcome = run_named_stage(stage, run, lambda line: None)

    given = read_arrays(tmp_path / "home/late/undistorted/images.zarr")
    shown = read_arrays(tmp_path / "home/late/novel_views/smoke/0/test/model.zarr")
    assert shown["front_frame"].tolist() == [3, FRAMES - 2] and outcome.metadata["test_front_images"] == 2
    row = np.searchsorted(given["front_frame"], shown["front_frame"])
    np.testing.assert_allclose(shown["front_time_s"], given["front_time_s"][row], atol=1e-9)
    poses = shown["front_camera_to_world"]
    np.testing.assert_allclose(poses, given["front_camera_to_world"][row], atol=1e-9)
    images = read_rows(tmp_path / "home/late/frames/cameras.parquet")
    (left_out,) = [image for image in images if not image["image_valid"]]
    assert left_out["frame"] == FRAMES - 1 and "no pose at the time of the image" in left_out["reason"]


def test_an_import_keeps_poses_and_images_on_one_clock_where_times_are_refused(
    scene: SceneEntry, tmp_path: Path
) -> None:
    layout = PlainLayout(scene.root)
    moments = np.arange(FRAMES) * PERIOD_S
    # A pause of a quarter of an hour: the times of the frames are replaced by nominal ones.
    paused = np.where(np.arange(FRAMES) < 5, moments, moments + 900.0)
    copy = PlainLayout(tmp_path / "paused")
    for file in layout.root.rglob("*"):
        if file.is_file():
            to = copy.root / file.relative_to(layout.root)
            to.parent.mkdir(parents=True, exist_ok=True)
            to.write_bytes(file.read_bytes())
    write_poses(copy, range(FRAMES), paused.tolist(), [place(one) for one in moments])
    write_image_times(copy, "front", {frame: float(paused[frame]) + 0.04 for frame in range(FRAMES - 1)})
    done = import_drive(
        replace(scene, root=copy.root, test_frames=()), tmp_path / "out", progress=lambda line: None
    )
    found = PlainLayout(done.folder)
    image_s, pose_s = (
        {row[0]: float(row[1]) for row in map(str.split, file.read_text().replace(",", " ").splitlines()[1:])}
        for file in (found.image_times_path("front"), found.poses_path)
    )
    assert len(image_s) == FRAMES - 1 and max(pose_s.values()) < 10.0
    for frame, moment_s in image_s.items():
        assert moment_s == pytest.approx(pose_s[frame] + 0.04, abs=1e-6)
