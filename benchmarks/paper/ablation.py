"""The paper's ablation and its three ways of encoding, repeated at the size of `paper_cpu`.

Run ``python -m benchmarks.paper.ablation [--seeds 3] [--table]`` (``make ablation``). A finished run stands
in benchmarks/results/ablation.json and is never repeated; a killed one goes on from its checkpoint.
Scored on the held-out frames: every fourth pano column (protocol `lidar4d`), images at a quarter of
width and height; the baselines as the newest views of the scene that `make train` published show them.
`--table` only writes docs/ablation.md from the results.
"""

import argparse
import os
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.common.compared import SHARE, scan_of
from benchmarks.common.documents import Row, read_rows, write_rows
from benchmarks.paper.ablation_scoring import (
    IMAGE_STEP,
    Scene,
    Scored,
    baseline_rows,
    rows_of,
    score_images,
    score_pano,
)
from benchmarks.paper.ablation_table import RESULTS, write_table
from nvsf_core.drives.catalogue import SceneEntry, home_from_environment
from nvsf_core.geometry.se3 import pose_from_parts, poses_in
from nvsf_core.metrics.protocols import PanoImage
from nvsf_core.metrics.table import BASELINES
from nvsf_core.models.paper.family import train_on_frames
from nvsf_core.models.paper.scene import load, training_frames
from nvsf_core.recipe.paper import PaperRecipe
from nvsf_core.recipe.presets import ABLATION, ENCODINGS
from nvsf_core.recording.drive import Recording
from nvsf_core.rendering.warping import shrunk
from nvsf_core.simulation.scene_model import ImageRenderer, SceneModel
from nvsf_core.stages import STAGE_NAMES
from nvsf_core.stages.inputs import read_recording
from nvsf_core.stages.runner.checkpoints import StageSession
from nvsf_core.stages.runner.run import (
    SceneRun,
    find_scene,
    plan_run,
    run_named_stage,
    say_on_stderr,
    write_demo_where_absent,
)
from nvsf_core.stages.scoring.moving_boxes import read_moving_boxes
from nvsf_core.stores.arrays import read_arrays
from nvsf_core.stores.checkpoints import StoredWeights

PLAN: tuple[tuple[str, tuple[PaperRecipe, ...]], ...] = (
    ("street", ABLATION),
    ("kitti0005_van_cyclist", ABLATION),
    ("k360_street", ENCODINGS),
)


def main() -> None:
    """Do the runs that are not done yet, then write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--scenes", nargs="*", default=[name for name, _ in PLAN])
    parser.add_argument("--table", action="store_true", help="only write docs/ablation.md")
    arguments = parser.parse_args()
    for name, recipes in () if arguments.table else PLAN:
        if name in arguments.scenes:
            _run_scene(name, recipes, arguments.seeds)
    write_table()


def _run_scene(name: str, recipes: tuple[PaperRecipe, ...], seeds: int) -> None:
    done = {(row["variant"], row["seed"]) for row in read_rows(RESULTS) if row["scene"] == name}
    # Seeds outermost: one whole ablation stands before any variant is repeated.
    left = [(r, seed) for seed in range(seeds) for r in recipes if (r.name, seed) not in done]
    unlearned = [one for one in BASELINES if (one, 0) not in done]
    if not left and not unlearned:
        say_on_stderr(f"[{name}] all runs are done ({RESULTS})")
        return
    scene = _prepare(name, recipes[0])
    for one in unlearned:
        write_rows(RESULTS, [*read_rows(RESULTS), *baseline_rows(scene, one)])
    for recipe, seed in left:
        started = time.perf_counter()
        rows = _run(scene, recipe, seed)
        write_rows(RESULTS, [*read_rows(RESULTS), *rows])
        say_on_stderr(f"[{name}] {recipe.name}, seed {seed}: {time.perf_counter() - started:.0f} s")


def _prepare(name: str, recipe: PaperRecipe) -> Scene:
    """What every run of the scene needs."""
    run, recording = prepared_recording(find_scene(name), recipe, home_from_environment(os.environ))
    # Every variant reads the cameras' images; those without camera rays leave them alone.
    frames = training_frames(ENCODINGS[0], recording)
    return Scene(run=run, recording=recording, frames=frames, boxes=read_moving_boxes(run.store))


def prepared_recording(entry: SceneEntry, recipe: PaperRecipe, home: Path) -> tuple[SceneRun, Recording]:
    """Run the stages before `field` where they are not up to date, and read what they recorded."""
    write_demo_where_absent(entry, say_on_stderr)
    run = plan_run(entry, home, recipe=recipe)
    for stage in STAGE_NAMES[: STAGE_NAMES.index("field")]:
        run_named_stage(stage, run, say_on_stderr)
    return run, read_recording(run.store)


def _run(scene: Scene, recipe: PaperRecipe, seed: int) -> list[Row]:
    """Train one variant and score it."""
    plan = plan_run(scene.run.scene, scene.run.store.home, recipe=recipe, seed=seed)
    place = f"ablation/{recipe.name}/{seed}"
    work = plan.store.work_dir(place)
    session = StageSession(plan.task(work, say_on_stderr), work)
    trained = train_on_frames(recipe, scene.recording, scene.frames, session)
    model = load(recipe, StoredWeights(trained.tensors, trained.facts, work), scene.recording)
    rows = rows_of(_scored(scene, model), plan.scene.name, recipe.name, seed)
    plan.store.drop_work_dir(place)
    return rows


def _scored(scene: Scene, model: SceneModel) -> Scored:
    """Of each held-out frame and sensor."""
    for frame in scene.run.scene.test_frames:
        yield from score_pano(scene, frame, _shown_pano(scene, model, frame))
    if model.camera is not None:
        for name in scene.recording.cameras:
            yield from score_images(scene, name, _shown_images(scene, model.camera, name))


def _shown_pano(scene: Scene, model: SceneModel, frame: int) -> PanoImage:
    lidar = scene.recording.lidar
    assert lidar is not None and model.pano is not None
    time_s = lidar.sweeps.arrays["time_s"][scan_of(lidar, frame)]
    pose = pose_from_parts(*lidar.sweeps.trajectory.at(np.array([time_s])))[0]
    # Of this family's own: other panos cannot be thinned.
    range_m, intensity, hit = model.pano(pose, float(time_s), column_step=SHARE)
    return PanoImage(range_m=range_m, intensity=intensity, hit=hit)


def _shown_images(scene: Scene, render: ImageRenderer, camera: str) -> Iterator[tuple[int, np.ndarray]]:
    """Frame and small image of each held-out frame that the camera recorded."""
    recording = scene.recording
    keys = (f"{camera}_frame", f"{camera}_camera_to_world")
    stored = read_arrays(scene.run.store.require("undistorted") / "images.zarr", *keys)
    time_of = dict(zip(recording.posed_frame.tolist(), recording.posed_time_s.tolist(), strict=True))
    small = shrunk(recording.cameras[camera].training.pinhole, IMAGE_STEP)
    for frame, camera_to_world in zip(*(stored[key] for key in keys), strict=True):
        if frame in scene.run.scene.test_frames:
            pose = poses_in(recording.trajectory.scene_to_world, camera_to_world)
            yield int(frame), render(camera, small, pose, time_of[int(frame)]).rgb


if __name__ == "__main__":
    main()
