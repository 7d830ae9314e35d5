"""True images of a view are rectified as their camera's recorded ones, and belong to the frames asked for."""

import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from nvsf_core.drives.entries import SceneEntry
from nvsf_core.drives.plain.layout import PlainLayout
from nvsf_core.drives.plain.writer import write_description, write_plain_image, write_poses
from nvsf_core.drives.view_entry import ViewEntry
from nvsf_core.drives.view_parts import Waypoint
from nvsf_core.errors import DataError
from nvsf_core.geometry.se3 import pose_of_angles
from nvsf_core.simulation.view_plan import ViewPlan
from nvsf_core.stages import plan_run, run_named_stage
from nvsf_core.stages.runner.stage import Task
from nvsf_core.stages.scoring.recorded_truth import recorded_truth
from nvsf_core.stages.scoring.view_images import TrueImages
from nvsf_core.stages.views.view import plan_arrays, plan_attrs
from nvsf_core.stores.arrays import read_arrays, write_arrays

FRAMES, ASKED = 5, (1, 2)
TIMES_S = [0.1 * k for k in range(FRAMES)]
VIEW = ViewEntry(name="again", frames=ASKED, truth=(("front", Path("true")),))
LENS = {
    "model": "pinhole", "width": 64, "height": 48, "fx": 40.0, "fy": 40.0, "cx": 32.0, "cy": 24.0,
    "distortion": {"k1": -0.2, "k2": 0.05}, "camera_to_lidar": np.eye(4).ravel().tolist(),
}  # fmt: skip


def _drive(folder: Path, view: ViewEntry) -> tuple[PlainLayout, SceneEntry]:
    """Images of one camera on a straight way, of which those of the frames ASKED are true ones of a view."""
    layout = PlainLayout(folder / "drive")
    write_description(layout, "VLP-16")
    layout.cameras_path.write_text(json.dumps({"front": LENS}))
    poses = [pose_of_angles((float(k), 0.0, 0.0), 0.0, 0.0, 0.0) for k in range(FRAMES)]
    write_poses(layout, range(FRAMES), TIMES_S, poses)
    random = np.random.default_rng(0)
    for frame in range(FRAMES):
        write_plain_image(layout, "front", frame, random.integers(0, 255, (48, 64, 3), np.uint8))
    (layout.root / "true").mkdir()
    for frame in ASKED:
        shutil.copy(layout.image_path("front", frame), layout.root / "true" / f"{frame:010d}.png")
    return layout, SceneEntry(
        name="tiny", root=layout.root, sequence="there", kind="plain", first_frame=0, last_frame=FRAMES - 1,
        test_frames=(), views=(view,),
    )  # fmt: skip


def _truths(folder: Path, scene: SceneEntry, nearest: Sequence[int]) -> tuple[list[TrueImages], np.ndarray]:
    """True images of a scene's only view at the times of the frames ASKED, and the drive's own images.

    Args:
        folder: Of the home.
        scene: The scene.
        nearest: Recorded frames whose places are nearest to the view's.
    """
    run = plan_run(scene, folder / "home", recipe="smoke")
    for stage in ("frames", "undistorted"):
        run_named_stage(stage, run, lambda line: None)
    plan = ViewPlan("again", np.array(nearest), np.array([TIMES_S[frame] for frame in ASKED]), None)
    shown = folder / "again/model.zarr"
    write_arrays(
        shown, {**plan_arrays(plan), "front_frame": plan.frame}, {**plan_attrs(plan), "cameras": ["front"]}
    )
    task = Task(scene=scene, store=run.store, config=run.config, folder=folder, progress=lambda line: None)
    own = read_arrays(run.store.require("undistorted") / "images.zarr", "front_rgb")["front_rgb"]
    return list(recorded_truth(task, shown, scene.views[0])), own


def test_truth_of_a_camera_with_distortion_is_rectified_as_its_own_images_are(tmp_path: Path) -> None:
    _, scene = _drive(tmp_path, VIEW)
    (found,), own = _truths(tmp_path, scene, ASKED)
    assert np.array_equal(found.rgb, own[list(ASKED)]) and found.frame.tolist() == list(ASKED)


def test_truth_of_a_camera_of_jpegs_is_found_and_read_under_the_names_that_its_drive_may_have(
    tmp_path: Path,
) -> None:
    layout, scene = _drive(tmp_path, VIEW)
    for frame, name in ((1, "1.jpg"), (2, "0000000002.JPEG")):
        true = layout.root / f"true/{frame:010d}.png"
        cv2.imwrite(str(true.with_name(f"{name}.jpg")), cv2.imread(str(true)))
        true.with_name(f"{name}.jpg").rename(true.with_name(name))
        true.unlink()
    (found,), own = _truths(tmp_path, scene, ASKED)
    assert found.frame.tolist() == list(ASKED)
    apart = np.abs(found.rgb.astype(int) - own[list(ASKED)])
    assert 0 < apart.mean() < 60, "the same noise, but for what JPEG takes away"


def test_truth_on_a_path_of_its_own_belongs_to_the_frames_asked_for_not_to_those_nearest_in_place(
    tmp_path: Path,
) -> None:
    ahead = tuple(Waypoint(time_s=t, position_m=(10.0 * t + 1.0, 0.0, 0.0)) for t in (0.1, 0.2))
    _, scene = _drive(tmp_path, replace(VIEW, waypoints=ahead))
    (found,), own = _truths(tmp_path, scene, [frame + 1 for frame in ASKED])
    assert np.array_equal(found.rgb, own[list(ASKED)]) and found.row.tolist() == [0, 1]


def test_true_images_of_no_frame_of_the_view_are_refused_before_training_and_not_measured(
    tmp_path: Path,
) -> None:
    late = tuple(Waypoint(time_s=t, position_m=(10.0 * t, 0.0, 0.0)) for t in (0.3, 0.4))
    layout, scene = _drive(tmp_path, replace(VIEW, frames="all", waypoints=late))
    with pytest.raises(DataError, match=r"some of the view's frames, 3 to 4, found those of \[1, 2\]"):
        plan_run(scene, tmp_path / "home", recipe="smoke")
    (layout.root / "true/0000000001.png").rename(layout.root / "true/0000000003.png")
    (layout.root / "true/0000000002.png").unlink()
    # The frames that are shown have no truth: the poses may be refused only later.
    found, _ = _truths(tmp_path, scene, ASKED)
    assert found == []
