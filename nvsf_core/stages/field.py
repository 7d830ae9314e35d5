"""Stage `field`: the scene's model, trained on all training frames; resumes where it was killed.

Here, and nowhere else, a family of recipes is chosen: how it is trained and how its model is loaded.
"""

import json
import resource
from dataclasses import replace
from pathlib import Path

from nvsf_core._types import Scalar
from nvsf_core.errors import RecipeError
from nvsf_core.recipe import PaperRecipe, ResidualRecipe
from nvsf_core.recording.drive import Recording
from nvsf_core.simulation.scene_model import SceneModel
from nvsf_core.stages.checks.field import LAWS, check_loss, check_rendering, check_weights
from nvsf_core.stages.field_profile import field_profile
from nvsf_core.stages.inputs import read_recording
from nvsf_core.stages.paper_model import load_paper_model
from nvsf_core.stages.paper_training import train_paper
from nvsf_core.stages.residual_model import load_residual_model
from nvsf_core.stages.residual_training import train_residual
from nvsf_core.stages.runner.checkpoints import Trained
from nvsf_core.stages.runner.divergence import go_on
from nvsf_core.stages.runner.stage import Check, Stage, StageOutput, Task
from nvsf_core.stores.checkpoints import save_tensors
from nvsf_core.stores.tables import write_table


def load_model(task: Task, recording: Recording) -> SceneModel:
    """The model that this stage published for the task's recipe and seed, ready to render.

    Raises:
        StoreError: It was never published, or its weights cannot be read.
    """
    return _load(task, task.store.require(STAGE.location(task.config)), recording)


def _load(task: Task, folder: Path, recording: Recording) -> SceneModel:
    if isinstance(task.config.recipe, PaperRecipe):
        return load_paper_model(folder, recording)
    return load_residual_model(folder, recording)


def train_model(task: Task, recording: Recording, work: Path) -> Trained:
    """Train the recipe's family of models, resuming from the checkpoints in `work`.

    Raises:
        RecipeError: Nothing here trains such a recipe.
    """
    recipe = task.config.recipe
    if isinstance(recipe, PaperRecipe):
        return train_paper(task, recipe, recording, work)
    if isinstance(recipe, ResidualRecipe):
        return train_residual(task, recipe, recording, work)
    raise RecipeError(f"expected a recipe of the family residual or paper, found {type(recipe).__name__}")


def _run(task: Task) -> StageOutput:
    recording = read_recording(task.store)
    location = STAGE.location(task.config)
    needs = field_profile(task.config.recipe, recording)
    if needs:
        task.progress(f"[{task.scene.name}] field: {needs['needs']}")
    work = task.store.work_dir(location)
    went_on = go_on(task, work)
    trained = train_model(task, recording, work)
    _write(task, trained, recording)
    task.store.drop_work_dir(location)
    output = StageOutput(
        metadata={
            **needs,
            "train_seconds": trained.seconds,
            "parameters": sum(value.numel() for value in trained.tensors.values()),
            "model_mb": sum(value.nbytes for value in trained.tensors.values()) / 1e6,
            "peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
            **trained.metadata,
            **_ends(trained),
        },
        checks=[check_weights(trained.tensors), check_loss(trained.curves)],
    )
    if output.checks[0].passed:
        output.checks += _check_rendering(task, recording)
    if went_on:
        output.checks.append(Check(name="training_never_diverged", passed=False, detail=went_on))
    return output


def _check_rendering(task: Task, recording: Recording) -> list[Check]:
    """What the weights in the task's folder render of a training scan."""
    if isinstance(task.config.recipe, ResidualRecipe):
        # Such a camera prepares all its images as it is loaded, and only the LiDAR is judged.
        recording = replace(recording, cameras={})
    return check_rendering(_load(task, task.folder, recording), recording)


def _ends(trained: Trained) -> dict[str, Scalar]:
    """First and last recorded loss, and the speed where rays are drawn, by part of the model."""
    found: dict[str, Scalar] = {}
    for part, curve in trained.curves.items():
        found |= {f"{part}_loss_first": curve[0]["loss"], f"{part}_loss_last": curve[-1]["loss"]}
        if "rays_per_s" in curve[-1]:
            found[f"{part}_rays_per_s"] = curve[-1]["rays_per_s"]
    return found


def _write(task: Task, trained: Trained, recording: Recording) -> None:
    facts = trained.facts | {"has_lidar": recording.lidar is not None, "has_camera": bool(recording.cameras)}
    save_tensors(task.folder / "weights.safetensors", trained.tensors, facts)
    recipe = task.config.recipe
    (task.folder / "recipe.json").write_text(json.dumps(recipe.to_json(), indent=1, sort_keys=True))
    rows = [{"sensor": sensor, **row} for sensor, curve in trained.curves.items() for row in curve]
    # Sensors have different loss terms: what one has not is unknown in its rows.
    names = dict.fromkeys(name for row in rows for name in row)
    write_table(task.folder / "curve.parquet", {name: [row.get(name) for row in rows] for name in names})


STAGE = Stage(
    name="field",
    group="train",
    inputs=("frames", "sweeps", "pano", "undistorted", "evidence"),
    description="The scene's trained model, for each sensor that the drive has, with the recipe and the "
    "training curve.",
    version="13",
    run=_run,
    per_recipe=True,
    laws=LAWS,
)
