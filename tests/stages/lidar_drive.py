"""A short demo drive of a LiDAR alone, by the real stages up to what a field is trained from."""

import shutil
from pathlib import Path

from nvsf_core.demo.drive import DEMO_SEQUENCE, DemoSize, write_demo
from nvsf_core.demo.motion import EgoSpeed
from nvsf_core.drives.catalogue import SceneEntry
from nvsf_core.recipe.base import Recipe
from nvsf_core.stages import plan_run, run_named_stage
from nvsf_core.stages.runner.run import SceneRun

FRAMES = 9
LASERS = tuple(range(0, 64, 4))


def proven_drive(
    folder: Path,
    recipe: Recipe,
    *,
    firings: int,
    held_out: tuple[int, ...],
    speed: EgoSpeed | None = None,
    traffic: int = 0,
) -> SceneRun:
    """Nine scans of sixteen lasers in `folder`, proven by evidence; speed and traffic are `write_demo`'s."""
    size = DemoSize(
        frames=FRAMES, lasers=LASERS, firings=firings, cameras=("image_00",), width=32, height=16,
        fisheye_side=0,
    )  # fmt: skip
    write_demo(folder / "drive", size=size, speed=speed, traffic=traffic)
    shutil.rmtree(folder / "drive/data_2d_raw")
    scene = SceneEntry(
        name="proven", root=folder / "drive", sequence=DEMO_SEQUENCE, first_frame=0, last_frame=FRAMES - 1,
        test_frames=held_out, sweep_period_s=0.1,
    )  # fmt: skip
    run = plan_run(scene, folder / "home", recipe=recipe)
    for stage in ("frames", "sweeps", "undistorted", "pano", "evidence"):
        run_named_stage(stage, run, lambda line: None)
    return run
