"""One run of a curve in a process of its own, whose peak memory is then the training's.

``python -m benchmarks.speed_error.run SCENE SPLIT RECIPE SEED [--marks 5 15 ...]``; a baseline is a RECIPE
too, and so is a size of `paper_cpu`. ``--prepare`` runs the scene's stages up to `evidence` instead.
"""

import argparse
import os
import resource
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from benchmarks.common.documents import commit
from benchmarks.speed_error.marks import CAMERA, LIDAR, Marked, Marks
from benchmarks.speed_error.plan import FULL, MARKS_S, RESULTS, OneRun, Split, split_of, write_result
from benchmarks.speed_error.scoring import IMAGE_METRIC, Judge, judge_of, samples_a_ray, shrunk_images
from benchmarks.speed_error.sizes import NAME as PAPER_CPU
from benchmarks.speed_error.sizes import SIZE_SECONDS, SIZES, chosen_size, probe, timed
from nvsf_core.drives.catalogue import home_from_environment
from nvsf_core.metrics.table import BASELINES
from nvsf_core.models.baselines.reproject import reprojection
from nvsf_core.models.family import Trained, family_of
from nvsf_core.models.residual.lidar import SHOWS_FIELD
from nvsf_core.recipe.base import Recipe
from nvsf_core.recipe.paper import PaperRecipe
from nvsf_core.recipe.presets import preset
from nvsf_core.recording.drive import Recording
from nvsf_core.simulation.scene_model import SceneModel
from nvsf_core.stages import STAGE_NAMES
from nvsf_core.stages.inputs import read_recording
from nvsf_core.stages.mesh import read_mesh
from nvsf_core.stages.runner.checkpoints import StageSession
from nvsf_core.stages.runner.host import machine
from nvsf_core.stages.runner.locks import device_lock
from nvsf_core.stages.runner.record import read_record
from nvsf_core.stages.runner.run import (
    SceneRun,
    field_made_from,
    find_scene,
    run_named_stage,
    say_on_stderr,
    write_demo_where_absent,
)
from nvsf_core.stages.runner.stage import Observer, Progress, RunConfig
from nvsf_core.stores.checkpoints import StoredWeights, load_tensors
from nvsf_core.stores.scene_store import SceneStore

MESH = "mesh"
"""Stage and baseline of that name."""
PROTOCOL = "lidar4d_scan, raw and image, on a quarter of the rays and a sixteenth of the pixels"
_TIMED = (PAPER_CPU, *SIZES)
"""Recipes whose steps are as many as fit into their time."""
_BEFORE = STAGE_NAMES[: STAGE_NAMES.index("field")]
"""Stages whose outputs a training reads."""
_PROBE_STEPS = 8
_TRAINING_SHARE = 0.9
"""Of the seconds that a timed recipe has; the rest is for preparation and the U-Net."""

Point = dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """What all runs of a split share."""

    split: Split
    home: Path
    results: Path
    marks_s: Sequence[float]
    progress: Progress

    @property
    def store(self) -> SceneStore:
        """Outputs of the split's stages."""
        return self.split.store(self.home)


def main() -> None:
    """Prepare, or run and leave a JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene")
    parser.add_argument("split")
    parser.add_argument("recipe", nargs="?", default="")
    parser.add_argument("seed", nargs="?", type=int, default=0)
    parser.add_argument("--marks", nargs="*", type=float, default=MARKS_S)
    parser.add_argument("--prepare", action="store_true")
    arguments = parser.parse_args()
    scene = find_scene(arguments.scene)
    setting = Setting(
        split=split_of(scene, arguments.split), home=home_from_environment(os.environ), results=RESULTS,
        marks_s=sorted(arguments.marks), progress=say_on_stderr,
    )  # fmt: skip
    if arguments.prepare:
        write_demo_where_absent(scene, say_on_stderr)
        prepare(setting)
    else:
        run(setting, arguments.recipe, arguments.seed)


def prepare(setting: Setting) -> None:
    """Run the stages before `field`."""
    for name in dict.fromkeys((*_BEFORE, MESH)):
        run_named_stage(name, _scene_run(setting, preset("quick"), 0), setting.progress)


def asked_recipe(setting: Setting, name: str, seed: int) -> Recipe:
    """The recipe of a name; `paper_cpu` is the size that was the best on this scene's left-out frames."""
    if name == PAPER_CPU:
        return chosen_size(setting.results, setting.split.entry.name, seed)
    return SIZES[name] if name in SIZES else preset(name)


def run(setting: Setting, name: str, seed: int, asked: Recipe | None = None) -> Path:
    """Train a recipe (`asked`, or the name's), or prepare a baseline, score it, and write the JSON."""
    recording = shrunk_images(read_recording(setting.store), setting.split.image_divisor)
    judge = judge_of(recording, setting.store, setting.split.scored)
    started, load = time.perf_counter(), os.getloadavg()[0]
    if name in BASELINES:
        facts, points = _run_baseline(setting, judge, name)
    else:
        recipe = asked or asked_recipe(setting, name, seed)
        facts, points = _run_recipe(setting, recording, judge, recipe, seed)
    split, scene = setting.split, setting.split.entry.name
    about = {
        "recipe": name, "scene": scene, "split": split.name, "seed": seed, "protocol": PROTOCOL,
        "trained": list(split.trained), "scored": list(split.scored), "machine": machine(),
        "commit": commit(), "measured": f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC", "load_average": load,
        "image_px": [
            [c.training.pinhole.width, c.training.pinhole.height] for c in recording.cameras.values()
        ],
        "stage_seconds": _stage_seconds(setting), "run_seconds": time.perf_counter() - started,
    }  # fmt: skip
    path = OneRun(scene, split.name, name, seed).path(setting.results)
    rows = [{"recipe": name, "scene": scene, "seed": seed} | point for point in points]
    write_result(path, about | facts, rows)
    setting.progress(f"[{scene}] {name}, split {split.name}, seed {seed}: {path}")
    return path


def _run_baseline(setting: Setting, judge: Judge, name: str) -> tuple[dict[str, Any], list[Point]]:
    facts: dict[str, Any] = {"parameters": 0, "model_mb": 0.0, "train_seconds": 0.0}
    if name == "copy_nearest":
        return facts, _points(judge.copy_errors(), None, 0.0)
    if name == MESH:
        # Loads open3d, whose memory is not another run's.
        from nvsf_core.models.baselines.mesh import mesh_baseline

        record = read_record(setting.store.path(MESH))
        assert record is not None
        facts["model_mb"] = record["metadata"].get("model_mb")
        seconds = {LIDAR: record["seconds"], CAMERA: record["seconds"]}
        model = mesh_baseline(read_mesh(setting.store), judge.recording)
        if model is None:
            return facts | {"not_run": record["metadata"][MESH]}, []
    else:
        model = reprojection(judge.recording)
        seconds = {LIDAR: _evidence_seconds(setting), CAMERA: 0.0}
        facts |= {"samples_a_ray": samples_a_ray(judge, None), "model_mb": _evidence_mb(setting)}
    errors = judge.errors(model, thin_images=False)
    facts |= _render_seconds(judge, model, thin=False) | {"peak_memory_mb": _peak_memory_mb()}
    return facts | {"train_seconds": max(seconds.values())}, _final_points(errors, seconds)


def _run_recipe(
    setting: Setting, recording: Recording, judge: Judge, asked: Recipe, seed: int
) -> tuple[dict[str, Any], list[Point]]:
    with tempfile.TemporaryDirectory() as name, device_lock(setting.home / ".leases", setting.progress):
        recipe = _with_time(setting, recording, asked, seed)
        is_paper = isinstance(recipe, PaperRecipe)
        # Our LiDAR's field starts from what the evidence proves; the paper's and our camera's do not.
        before_s = 0.0 if is_paper else _evidence_seconds(setting)
        marks = Marks(Path(name), setting.marks_s, {LIDAR: before_s})
        trained = _train(setting, recording, recipe, seed, marks)
        marks.finish()
        memory_mb = _peak_memory_mb()
        say = setting.progress
        say(f"[{setting.split.entry.name}] {recipe.name}: trained in {trained.seconds:.0f} s, scoring")
        points = []
        for marked in marks.found:
            model = _of_clock(_model(recipe, recording, _as_of(marked, trained)), marked.clock)
            errors = judge.errors(model, thin_images=is_paper)
            points += _points(errors, marked.mark_s, marked.seconds)
        model = _model(recipe, recording, trained)
        points += _final_points(judge.errors(model, thin_images=is_paper), marks.seconds)
        size_mb = sum(tensor.nbytes for tensor in trained.tensors.values()) / 1e6
        facts = {
            "recipe_identity": asked.identity(), "recipe_json": recipe.to_json(),
            "train_seconds": trained.seconds + before_s, "clock_seconds": marks.seconds,
            "parameters": trained.metadata.get(
                "parameters", sum(tensor.numel() for tensor in trained.tensors.values())
            ),
            "model_mb": size_mb + (0.0 if is_paper else _evidence_mb(setting)),
            "peak_memory_mb": memory_mb, "samples_a_ray": samples_a_ray(judge, recipe),
            "rays_per_s": _rays_per_s(trained), "training": trained.metadata,
        }  # fmt: skip
        return facts | _render_seconds(judge, model, thin=is_paper), points


def _with_time(setting: Setting, recording: Recording, recipe: Recipe, seed: int) -> Recipe:
    """A size of `paper_cpu` with as many steps as its time allows; any other recipe as it is."""
    if not isinstance(recipe, PaperRecipe) or recipe.name not in _TIMED:
        return recipe
    seen: list[float] = []
    few = probe(recipe, _PROBE_STEPS)
    _train(setting, recording, few, seed, lambda _, state: seen.append(state.seconds))
    # The first steps load kernels.
    half = len(seen) // 2
    seconds_a_step = (seen[-1] - seen[half - 1]) / (len(seen) - half)
    if recipe.name in SIZES:
        without = replace(recipe, refinement=replace(recipe.refinement, channels=0))
        return timed(without, seconds_a_step, SIZE_SECONDS * _TRAINING_SHARE)
    return timed(recipe, seconds_a_step, max(setting.marks_s) * _TRAINING_SHARE)


def _train(setting: Setting, recording: Recording, recipe: Recipe, seed: int, observe: Observer) -> Trained:
    """Train from the beginning. A whole scene's last checkpoint stays, for the stage `field`."""
    scene_run = _scene_run(setting, recipe, seed)
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        if setting.split.name == FULL and recipe.name not in _TIMED:
            place = f"field/{recipe.name}/{seed}"
            setting.store.drop_work_dir(place)
            work = setting.store.work_dir(place)
        made_from = field_made_from(scene_run)
        task = replace(scene_run.task(work, setting.progress), observe=observe, made_from=made_from)
        return family_of(recipe).train(recipe, recording, StageSession(task, work))


def _scene_run(setting: Setting, recipe: Recipe, seed: int) -> SceneRun:
    return SceneRun(
        scene=setting.split.entry, store=setting.store, config=RunConfig(recipe=recipe, seed=seed)
    )  # fmt: skip


def _as_of(marked: Marked, trained: Trained) -> Trained:
    """The model as it would have been published at a mark: the other parts as they ended."""
    found, _ = load_tensors(marked.path)
    # A paper's field is shown by itself until its U-Net is trained.
    kept = {name: value for name, value in trained.tensors.items() if not name.startswith("unet.")}
    facts = dict(trained.facts)
    if SHOWS_FIELD in facts:
        # Whether learning beat `reproject` is asked at the end only: until then, show what is learned.
        facts[SHOWS_FIELD] = True
    return replace(trained, tensors=kept | found, facts=facts)


def _model(recipe: Recipe, recording: Recording, trained: Trained) -> SceneModel:
    weights = StoredWeights(trained.tensors, trained.facts, Path(recipe.name))
    return family_of(recipe).load(recipe, weights, recording)


def _of_clock(model: SceneModel, clock: str) -> SceneModel:
    """What a mark of a clock says something about."""
    if clock == LIDAR:
        # What corrects a turn's hits is trained after the field: no mark but the end has it.
        return replace(model, camera=None, correct=None)
    return model


def _points(errors: Mapping[str, float], mark_s: float | None, seconds: float) -> list[Point]:
    return [
        {"mark": mark_s, "seconds": round(seconds, 3), "metric": metric, "value": value}
        for metric, value in errors.items()
    ]


def _final_points(errors: Mapping[str, float], seconds: Mapping[str, float]) -> list[Point]:
    """Each sensor's errors at the end of its own clock, or of the only one."""
    points = []
    for metric, value in errors.items():
        clock = CAMERA if metric == IMAGE_METRIC else LIDAR
        points += _points({metric: value}, None, seconds.get(clock, max(seconds.values())))
    return points


def _rays_per_s(trained: Trained) -> float | None:
    """Of the first part that is trained along rays, over all its steps."""
    curve = trained.curves.get("lidar") or trained.curves.get("field") or []
    return curve[-1]["rays_per_s"] if curve else None


def _render_seconds(judge: Judge, model: SceneModel, *, thin: bool) -> dict[str, Any]:
    return {
        "sweep_seconds": judge.sweep_seconds(model), "image_seconds": judge.image_seconds(model, thin=thin)
    }  # fmt: skip


def _stage_seconds(setting: Setting) -> dict[str, float]:
    records = {name: read_record(setting.store.path(name)) for name in _BEFORE}
    return {name: record["seconds"] for name, record in records.items() if record is not None}


def _evidence_seconds(setting: Setting) -> float:
    return _stage_seconds(setting).get("evidence", 0.0)


def _evidence_mb(setting: Setting) -> float:
    folder = setting.store.path("evidence")
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 1e6


def _peak_memory_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


if __name__ == "__main__":
    main()
