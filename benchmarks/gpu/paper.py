"""`paper`'s iterations a second and memory, by how many rays are held at once; then minutes of training."""

from collections.abc import Iterator
from dataclasses import replace

import torch

from benchmarks.gpu.plan import Plan
from benchmarks.gpu.tests import Row
from benchmarks.paper.ablation import prepared_recording
from benchmarks.paper.step import iterations
from benchmarks.speed_error.marks import CAMERA, LIDAR
from benchmarks.speed_error.plan import FULL, read_result, split_of
from benchmarks.speed_error.run import Setting, run
from benchmarks.speed_error.sizes import probe, timed
from nvsf_core.drives.catalogue import SceneEntry
from nvsf_core.drives.drive import has_data
from nvsf_core.models.paper.scene import training_frames
from nvsf_core.recipe.base import Recipe
from nvsf_core.recipe.paper import PaperRecipe
from nvsf_core.recording.drive import Recording
from nvsf_core.stages.runner.run import say_on_stderr, write_demo_where_absent

_BASELINES = ("copy_nearest", "reproject")


def step_rows(plan: Plan) -> Iterator[Row]:
    """Iterations a second on each scene that has data, and the loss after them."""
    for scene, recording in _recordings(plan):
        yield from _steps_of(plan, scene, recording)


def training_rows(plan: Plan) -> Iterator[Row]:
    """Errors of the held-out frames: `paper` after some minutes, our recipes, and what learns nothing."""
    for scene, recording in _recordings(plan):
        for recipe in plan.ours:
            yield _trained(plan, scene, recipe.name, recipe)
        seconds = plan.minutes * 60.0
        step_s = float(str(_timed_steps(probe(plan.paper, 1), recording, plan.iterations)["seconds"]))
        timed_paper = timed(probe(plan.paper, 1), step_s, seconds)
        yield _trained(plan, scene, timed_paper.name, timed_paper)
        # They need no GPU; where one is lent and taken away, they can be measured afterwards.
        for name in _BASELINES:
            yield _trained(plan, scene, name, None)


def _recordings(plan: Plan) -> Iterator[tuple[SceneEntry, Recording]]:
    for scene in plan.scenes:
        write_demo_where_absent(scene, say_on_stderr)
        if has_data(scene):
            yield scene, prepared_recording(scene, plan.paper, plan.home)[1]


def _steps_of(plan: Plan, scene: SceneEntry, recording: Recording) -> Iterator[Row]:
    for rays in plan.rays_at_once:
        sampling = replace(plan.paper.sampling, rays_at_once=rays)
        about: Row = {"scene": scene.name, "rays_at_once": rays, "iterations": plan.iterations}
        try:
            yield about | _timed_steps(replace(plan.paper, sampling=sampling), recording, plan.iterations)
        except torch.OutOfMemoryError:
            yield about | {"not_run": "out of the GPU's memory"}


def _timed_steps(recipe: PaperRecipe, recording: Recording, count: int) -> Row:
    return iterations(recipe, training_frames(recipe, recording), count)


def _trained(plan: Plan, scene: SceneEntry, name: str, recipe: Recipe | None) -> Row:
    if torch.cuda.is_available():
        torch.cuda.reset_peak_memory_stats()
    setting = Setting(
        split=split_of(scene, FULL), home=plan.home, results=plan.home / ".gpu", marks_s=(),
        progress=say_on_stderr,
    )  # fmt: skip
    found = read_result(run(setting, name, 0, recipe))
    assert found is not None
    peak_mb = torch.cuda.max_memory_allocated() / 2**20 if recipe and torch.cuda.is_available() else None
    facts, parts = found["run"], found["run"].get("clock_seconds", {})
    return {
        "scene": scene.name, "method": name, "protocol": facts["protocol"],
        "steps": recipe.optimiser.steps if isinstance(recipe, PaperRecipe) else None,
        "train_s": facts["train_seconds"], "lidar_s": parts.get(LIDAR), "camera_s": parts.get(CAMERA),
        "sweep_s": facts.get("sweep_seconds"),
        "image_s": facts.get("image_seconds"), "peak_gpu_mb": peak_mb,
        **{point["metric"]: point["value"] for point in found["points"] if point["mark"] is None},
    }  # fmt: skip
