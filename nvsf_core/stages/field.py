"""Stage `field`: the scene's residual fields, trained on all training frames; resumes where it was killed."""

import json
import resource
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from nvsf_core.errors import DataError, DivergedError, StoreError
from nvsf_core.evidence.scene_evidence import SceneEvidence
from nvsf_core.fields.camera_field import CameraField
from nvsf_core.fields.lidar_field import LidarField
from nvsf_core.geometry.bounds import Bounds
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.recipe import Recipe
from nvsf_core.stages.evidence import Sweeps, read_evidence, read_sweeps
from nvsf_core.stages.stage import Check, Stage, StageOutput, Task
from nvsf_core.stores.arrays import read_arrays, read_attrs
from nvsf_core.stores.checkpoints import load_tensors, save_tensors
from nvsf_core.stores.scene_store import SceneStore
from nvsf_core.stores.tables import read_table, write_table
from nvsf_core.training.camera_step import camera_step
from nvsf_core.training.lidar_rays import LidarRays, dropped_rays, join_rays
from nvsf_core.training.lidar_step import lidar_step
from nvsf_core.training.loop import Step, TrainingState, make_optimiser, train
from nvsf_core.training.pixels import CameraImages

CURVE_COLUMNS = ("sensor", "step", "seconds", "loss", "rays_per_s", "depth", "hit", "intensity", "colour")


def far_m(sweeps: Sweeps) -> float:
    """How far a simulated ray is followed."""
    return float(sweeps.table.max_range_m)


def scene_bounds(evidence: SceneEvidence) -> Bounds:
    """The cube around all proven surfaces."""
    mean = evidence.surfels.mean_m
    return Bounds.around(tuple(mean.min(axis=0).tolist()), tuple(mean.max(axis=0).tolist()))


def make_lidar_field(recipe: Recipe, evidence: SceneEvidence, seed: int) -> LidarField:
    """An untrained field of this scene's size."""
    return LidarField(recipe.lidar_field, scene_bounds(evidence), torch.Generator().manual_seed(seed))


def make_camera_field(recipe: Recipe, evidence: SceneEvidence, seed: int) -> CameraField:
    """An untrained field of this scene's size."""
    return CameraField(recipe.camera_field, scene_bounds(evidence), torch.Generator().manual_seed(seed))


def load_fields(
    store: SceneStore, location: str, evidence: SceneEvidence
) -> tuple[LidarField, CameraField | None]:
    """The trained fields as the stage published them; the camera's is None where there were no images."""
    folder = store.require(location)
    recipe = Recipe.from_json(json.loads((folder / "recipe.json").read_text()))
    tensors, facts = load_tensors(folder / "weights.safetensors")
    lidar = make_lidar_field(recipe, evidence, 0)
    lidar.load_state_dict(_named(tensors, "lidar."))
    if not facts["has_camera"]:
        return lidar, None
    camera = make_camera_field(recipe, evidence, 0)
    camera.load_state_dict(_named(tensors, "camera."))
    return lidar, camera


def read_images(
    store: SceneStore, scene_origin_m: np.ndarray, training_frames: set[int]
) -> dict[str, tuple[CameraImages, np.ndarray]]:
    """Training images by camera, poses scene-local, and their frame numbers."""
    folder = store.require("undistorted") / "images.zarr"
    found = {}
    for name, facts in read_attrs(folder)["cameras"].items():
        arrays = read_arrays(
            folder, f"{name}_rgb", f"{name}_valid", f"{name}_frame", f"{name}_camera_to_world"
        )
        frame = arrays[f"{name}_frame"]
        used = np.isin(frame, list(training_frames))
        pose = arrays[f"{name}_camera_to_world"][used].copy()
        pose[:, :3, 3] -= scene_origin_m
        pinhole = Pinhole(**{key: facts[key] for key in ("fx", "fy", "cx", "cy", "width", "height")})
        pixel = np.flatnonzero(arrays[f"{name}_valid"].reshape(-1))
        if used.any():
            found[name] = (CameraImages(pinhole, arrays[f"{name}_rgb"][used], pose, pixel), frame[used])
    return found


def training_frames(store: SceneStore) -> set[int]:
    """Frame numbers that may be trained on."""
    table = read_table(store.require("frames") / "frames.parquet")
    return {f for f, split in zip(table["frame"], table["split"], strict=True) if split == "train"}


def _run(task: Task) -> StageOutput:
    started = time.perf_counter()
    recipe, seed = task.config.recipe, task.config.seed
    sweeps, evidence = read_sweeps(task.store), read_evidence(task.store)
    if sweeps is None or evidence is None:
        raise DataError(
            f"scene {task.scene.name}: recipe {recipe.name} starts from LiDAR evidence and this drive has "
            "no scan; a recipe that learns from images alone comes with a later version"
        )
    torch.set_num_threads(recipe.lidar_training.threads)
    rays = _training_rays(sweeps, evidence, recipe)
    prepared_s = time.perf_counter() - started
    lidar = make_lidar_field(recipe, evidence, seed)
    limit = far_m(sweeps)
    lidar_state = _fit(
        task, "lidar", lidar, lambda g: lidar_step(lidar, evidence.surfels, rays, recipe, limit, g)
    )
    images = read_images(task.store, sweeps.scene_origin_m, training_frames(task.store))
    curve = [{"sensor": "lidar", **row} for row in lidar_state.curve]
    tensors = {f"lidar.{name}": value for name, value in lidar.state_dict().items()}
    camera_s = 0.0
    if images:
        cameras = [camera for camera, _ in images.values()]
        camera = make_camera_field(recipe, evidence, seed + 1)
        state = _fit(
            task, "camera", camera, lambda g: camera_step(camera, evidence.surfels, cameras, recipe, g)
        )
        curve += [{"sensor": "camera", **row} for row in state.curve]
        tensors |= {f"camera.{name}": value for name, value in camera.state_dict().items()}
        camera_s = state.seconds
    _write(task.folder, tensors, recipe, curve, has_camera=bool(images))
    task.store.drop_work_dir(STAGE.location(task.config))
    first, last = lidar_state.curve[0]["loss"], lidar_state.curve[-1]["loss"]
    return StageOutput(
        metadata={
            "train_seconds": prepared_s + lidar_state.seconds + camera_s,
            "lidar_seconds": lidar_state.seconds,
            "camera_seconds": camera_s,
            "training_rays": len(rays),
            "parameters": sum(value.numel() for value in tensors.values()),
            "model_mb": sum(value.nbytes for value in tensors.values()) / 1e6,
            "peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
            "lidar_loss_first": first,
            "lidar_loss_last": last,
            "lidar_rays_per_s": lidar_state.curve[-1]["rays_per_s"],
        },
        checks=[
            Check(
                name="weights_are_finite",
                passed=all(bool(torch.isfinite(value).all()) for value in tensors.values()),
                detail=f"{len(tensors)} tensors",
                blocking=True,
            ),
            Check(name="training_lowered_the_loss", passed=last < first, detail=f"{first:.4f} to {last:.4f}"),
        ],
    )


def _training_rays(sweeps: Sweeps, evidence: SceneEvidence, recipe: Recipe) -> LidarRays:
    """Returns and drops of all training scans, each with the vote of the other scans."""
    parts = []
    a = sweeps.arrays
    for number, scan in enumerate(np.flatnonzero(sweeps.is_training)):
        time_s = float(a["time_s"][scan])
        alone = len(evidence.prior.time_s) == 1
        scans = evidence.prior.nearest_scans(
            time_s, recipe.evidence.votes, leave_out_s=None if alone else time_s
        )
        part = sweeps.returns_of(int(scan))
        kept = ~a["is_own_vehicle"][part] & (a["laser"][part] >= 0) & (a["range_m"][part] < far_m(sweeps))
        vote = evidence.prior.vote(a["laser"][part][kept], a["sweep_fraction"][part][kept], scans)
        origin, direction = a["origin_m"][part][kept], a["direction"][part][kept]
        parts.append(LidarRays(origin, direction, a["range_m"][part][kept], a["intensity"][part][kept], vote))
        parts.append(
            dropped_rays(
                sweeps.table,
                evidence.prior,
                number,
                evidence.lasers,
                sweeps.trajectory,
                sweeps.period_s,
                scans,
            )
        )
    return join_rays(parts)


def _fit(task: Task, sensor: str, model: torch.nn.Module, step: Step) -> TrainingState:
    """Train one field, from its checkpoint where there is one."""
    recipe = task.config.recipe
    spec = recipe.lidar_training if sensor == "lidar" else recipe.camera_training
    generator = torch.Generator().manual_seed(task.config.seed * 2 + (sensor == "camera"))
    state = TrainingState(model, make_optimiser(model, spec), generator)
    path = task.store.work_dir(STAGE.location(task.config)) / f"{sensor}.safetensors"
    say = _teller(task, sensor)
    _resume(state, path, recipe, say)

    def save(tensors: dict[str, Tensor], facts: dict[str, object]) -> None:
        save_tensors(path, tensors, facts | {"recipe": recipe.identity()})

    try:
        train(state, spec, step, save, say)
    except DivergedError as error:
        raise DivergedError(f"scene {task.scene.name}, recipe {recipe.name}, {sensor}: {error}") from error
    return state


def _resume(state: TrainingState, path: Path, recipe: Recipe, say: Callable[[str], None]) -> None:
    if not path.is_file():
        return
    try:
        tensors, facts = load_tensors(path)
    except StoreError as error:
        say(f"checkpoint left aside: {error}")
        return
    if facts.get("recipe") == recipe.identity():
        state.restore(tensors, facts)
        say(f"resumed from the checkpoint at step {state.step}")


def _teller(task: Task, sensor: str) -> Callable[[str], None]:
    return lambda line: task.progress(f"[{task.scene.name}] field, {sensor}: {line}")


def _write(
    folder: Path,
    tensors: dict[str, Tensor],
    recipe: Recipe,
    curve: list[dict[str, object]],
    *,
    has_camera: bool,
) -> None:
    save_tensors(folder / "weights.safetensors", tensors, {"has_camera": has_camera})
    (folder / "recipe.json").write_text(json.dumps(recipe.to_json(), indent=1, sort_keys=True))
    write_table(folder / "curve.parquet", {name: [row.get(name) for row in curve] for name in CURVE_COLUMNS})


def _named(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name[len(prefix) :]: value for name, value in tensors.items() if name.startswith(prefix)}


STAGE = Stage(
    name="field",
    group="train",
    inputs=("frames", "sweeps", "undistorted", "evidence"),
    description="Trained residual fields of the scene, one for the LiDAR and one for the cameras, "
    "with the recipe and the training curve.",
    version="1",
    run=_run,
    per_recipe=True,
)
