"""The paper's ablation and its three ways of encoding, repeated at the size of `paper_cpu`.

Run ``python -m benchmarks.paper.ablation [--seeds 3] [--table]`` (``make ablation``). A finished run stands
in benchmarks/results/ablation.json and is never repeated; a killed one goes on from its checkpoint.
Scored on the held-out frames: every fourth pano column (protocol `lidar4d`), images at a quarter of
width and height; the baselines as the newest views of the scene that `make train` published show them.
`--table` only writes docs/ablation.md from the results.
"""

import argparse
import os
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

from benchmarks.paper.ablation_baselines import baseline_rows
from benchmarks.paper.ablation_scoring import (
    COLUMN_STEP,
    Scene,
    Scored,
    quarter,
    rows_of,
    score_image,
    score_pano,
)
from benchmarks.paper.ablation_table import RESULTS, Row, read_rows, write_rows, write_table
from nvsf_core.drives.catalogue import SceneEntry, home_from_environment
from nvsf_core.fields.raydrop_unet import RaydropUnet
from nvsf_core.fields.scene_field import SceneField
from nvsf_core.metrics.protocols import PanoImage
from nvsf_core.metrics.table import BASELINES
from nvsf_core.models.family import Trained
from nvsf_core.models.paper.render import PaperModel
from nvsf_core.models.paper.scene import frame_at, frame_count, training_frames
from nvsf_core.models.paper.training.train import train_on_frames
from nvsf_core.recipe import ABLATION, ENCODINGS, PaperRecipe
from nvsf_core.recording.drive import Recording
from nvsf_core.stages import STAGES
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
from nvsf_core.stages.runner.stage import Task
from nvsf_core.stages.scoring.moving_boxes import read_moving_boxes
from nvsf_core.stores.arrays import read_arrays
from nvsf_core.training.device import training_device

PLAN: tuple[tuple[str, tuple[PaperRecipe, ...]], ...] = (
    ("demo", ABLATION),
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
    done = {(row["variant"], row["seed"]) for row in read_rows() if row["scene"] == name}
    # Seeds outermost: one whole ablation stands before any variant is repeated.
    left = [(r, seed) for seed in range(seeds) for r in recipes if (r.name, seed) not in done]
    unlearned = [one for one in BASELINES if (one, 0) not in done]
    if not left and not unlearned:
        say_on_stderr(f"[{name}] all runs are done ({RESULTS})")
        return
    scene = _prepare(name, recipes[0])
    for one in unlearned:
        write_rows([*read_rows(), *baseline_rows(scene, one)])
    for recipe, seed in left:
        started = time.perf_counter()
        rows = [*read_rows(), *_run(scene, recipe, seed)]
        write_rows(rows)
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
    for stage in STAGES:
        if stage.name == "field":
            break
        run_named_stage(stage.name, run, say_on_stderr)
    return run, read_recording(run.store)


def _run(scene: Scene, recipe: PaperRecipe, seed: int) -> list[Row]:
    """Train one variant and score it."""
    plan = plan_run(scene.run.scene, scene.run.store.home, recipe=recipe, seed=seed)
    work = scene.run.store.work_dir(f"ablation/{recipe.name}/{seed}")
    with tempfile.TemporaryDirectory() as folder:
        task = Task(
            scene=plan.scene,
            store=plan.store,
            config=plan.config,
            folder=Path(folder),
            progress=say_on_stderr,
        )
        trained = train_on_frames(recipe, scene.recording, scene.frames, StageSession(task, work))
    model = _model(recipe, scene, trained)
    rows = rows_of(_scored(scene, model, recipe), scene.run.scene.name, recipe.name, seed)
    scene.run.store.drop_work_dir(f"ablation/{recipe.name}/{seed}")
    return rows


def _model(recipe: PaperRecipe, scene: Scene, trained: Trained) -> PaperModel:
    field = SceneField(recipe, frame_count(scene.recording), torch.Generator())
    field.load_state_dict(_named(trained, "field."))
    unet = RaydropUnet(recipe.refinement.channels, torch.Generator())
    unet.load_state_dict(_named(trained, "unet."))
    return PaperModel(
        recipe=recipe, field=field.to(training_device()), bounds=scene.frames.bounds,
        frame_at=frame_at(scene.recording), unet=unet.to(training_device()),
    )  # fmt: skip


def _named(trained: Trained, prefix: str) -> dict[str, torch.Tensor]:
    return {k.removeprefix(prefix): v for k, v in trained.tensors.items() if k.startswith(prefix)}


def _scored(scene: Scene, model: PaperModel, recipe: PaperRecipe) -> Scored:
    """Of each held-out frame and sensor."""
    for frame in scene.run.scene.test_frames:
        yield from score_pano(scene, frame, _shown_pano(scene, model, frame))
    if recipe.sampling.camera:
        yield from _scored_images(scene, model)


def _shown_pano(scene: Scene, model: PaperModel, frame: int) -> PanoImage:
    lidar = scene.recording.lidar
    assert lidar is not None
    a = lidar.sweeps.arrays
    k = int(np.flatnonzero(a["frame"] == frame)[0])
    rotation, position = lidar.sweeps.trajectory.at(a["time_s"][k : k + 1])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation[0], position[0]
    range_m, intensity, hit = model.render_pano(pose, float(a["time_s"][k]), column_step=COLUMN_STEP)
    return PanoImage(range_m=range_m, intensity=intensity, hit=hit)


def _scored_images(scene: Scene, model: PaperModel) -> Scored:
    folder = scene.run.store.require("undistorted") / "images.zarr"
    origin_m = scene.recording.scene_origin_m
    time_of = dict(zip(scene.recording.posed_frame.tolist(), scene.recording.posed_time_s, strict=True))
    for name, camera in scene.recording.cameras.items():
        keys = [f"{name}_{part}" for part in ("rgb", "valid", "frame", "camera_to_world")]
        rgb, valid, frame, pose = (read_arrays(folder, *keys)[key] for key in keys)
        small = quarter(camera.training.pinhole)
        for k in np.flatnonzero(np.isin(frame, scene.run.scene.test_frames)).tolist():
            local = pose[k].copy()
            local[:3, 3] -= origin_m
            shown = model.render_image(name, small, local, float(time_of[int(frame[k])])).rgb
            yield "all", score_image(shown, rgb[k], valid)


if __name__ == "__main__":
    main()
