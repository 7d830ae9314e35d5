"""True images of a view are rectified as the recorded images of their camera are."""

import json
import shutil
from pathlib import Path

import numpy as np

from nvsf_core.drives.entries import SceneEntry
from nvsf_core.drives.plain.layout import PlainLayout
from nvsf_core.drives.plain.writer import write_description, write_plain_image, write_poses
from nvsf_core.drives.view_entry import ViewEntry
from nvsf_core.stages import plan_run, run_named_stage
from nvsf_core.stages.runner.stage import Task
from nvsf_core.stages.scoring.recorded_truth import recorded_truth
from nvsf_core.stores.arrays import read_arrays, write_arrays

FRAMES, ASKED = 4, (1, 2)
LENS = {
    "model": "pinhole", "width": 64, "height": 48, "fx": 40.0, "fy": 40.0, "cx": 32.0, "cy": 24.0,
    "distortion": {"k1": -0.2, "k2": 0.05}, "camera_to_lidar": np.eye(4).ravel().tolist(),
}  # fmt: skip


def test_truth_of_a_camera_with_distortion_is_rectified_as_its_own_images_are(tmp_path: Path) -> None:
    layout = PlainLayout(tmp_path / "drive")
    write_description(layout, "VLP-16")
    layout.cameras_path.write_text(json.dumps({"front": LENS}))
    poses = [np.eye(4) for _ in range(FRAMES)]
    write_poses(layout, range(FRAMES), [0.1 * k for k in range(FRAMES)], poses)
    random = np.random.default_rng(0)
    for frame in range(FRAMES):
        write_plain_image(layout, "front", frame, random.integers(0, 255, (48, 64, 3), np.uint8))
    (layout.root / "true").mkdir()
    for frame in ASKED:
        shutil.copy(layout.image_path("front", frame), layout.root / "true" / f"{frame:010d}.png")
    view = ViewEntry(name="again", frames=ASKED, truth=(("front", Path("true")),))
    scene = SceneEntry(
        name="tiny", root=layout.root, sequence="there", kind="plain", first_frame=0, last_frame=FRAMES - 1,
        test_frames=(), views=(view,),
    )  # fmt: skip
    run = plan_run(scene, tmp_path / "home", recipe="smoke")
    for stage in ("frames", "undistorted"):
        run_named_stage(stage, run, lambda line: None)
    shown = tmp_path / "again.zarr"
    write_arrays(shown, {"front_frame": np.array(ASKED)}, {"cameras": ["front"]})
    task = Task(scene=scene, store=run.store, config=run.config, folder=tmp_path, progress=lambda line: None)
    (found,) = recorded_truth(task, shown, view)
    own = read_arrays(run.store.require("undistorted") / "images.zarr", "front_rgb")["front_rgb"]
    assert np.array_equal(found.rgb, own[list(ASKED)]) and found.frame.tolist() == list(ASKED)
