"""Stage `field`: train the scene's model on all training frames; a killed training resumes."""

import json
import resource
from pathlib import Path

from nvsf_core._types import Scalar
from nvsf_core.models.family import Trained, family_of
from nvsf_core.recipe.presets import recipe_from_json
from nvsf_core.recording.drive import Recording
from nvsf_core.simulation.scene_model import SceneModel
from nvsf_core.stages.checks.field import check_loss, check_rendering, check_weights
from nvsf_core.stages.flow import FIELD
from nvsf_core.stages.inputs import read_recording
from nvsf_core.stages.runner.checkpoints import StageSession
from nvsf_core.stages.runner.divergence import go_on
from nvsf_core.stages.runner.stage import Check, StageOutput, Task
from nvsf_core.stores.checkpoints import StoredWeights, save_tensors
from nvsf_core.stores.documents import read_document
from nvsf_core.stores.tables import write_table


def load_model(task: Task, recording: Recording) -> SceneModel:
    """The model that this stage published for the task's recipe and seed, ready to render.

    Raises:
        StoreError: It was never published, or its weights cannot be read.
        RecipeError: The stored recipe is of another version.
    """
    return load_trained(task.store.require(FIELD.location(task.config)), recording)


def load_trained(folder: Path, recording: Recording, *, with_camera: bool = True) -> SceneModel:
    """The model whose weights and recipe lie in an output folder of this stage, and that knows its drive.

    With `with_camera` it renders images too; preparing this takes seconds.

    Raises:
        StoreError: The weights cannot be read.
        RecipeError: The stored recipe is of another version.
    """
    recipe = recipe_from_json(read_document(folder / "recipe.json"))
    weights = StoredWeights.read(folder / "weights.safetensors")
    return family_of(recipe).load(recipe, weights, recording, with_camera=with_camera)


def run(task: Task) -> StageOutput:
    """Train the model and write it with its curves; the stage `field`."""
    recording = read_recording(task.store)
    location = FIELD.location(task.config)
    recipe = task.config.recipe
    family = family_of(recipe)
    work = task.store.work_dir(location)
    went_on = go_on(task, work)
    trained = family.train(recipe, recording, StageSession(task, work))
    _write(task, trained, recording)
    output = StageOutput(
        metadata={
            "train_seconds": trained.seconds,
            "parameters": sum(value.numel() for value in trained.tensors.values()),  # unless the family says
            "model_mb": sum(value.nbytes for value in trained.tensors.values()) / 1e6,
            "peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6,
            **trained.metadata,
            **_ends(trained),
        },
        checks=[check_weights(trained.tensors), check_loss(trained.curves)],
    )
    if output.checks[0].passed:
        output.checks += check_rendering(load_trained(task.folder, recording, with_camera=False), recording)
    if went_on:
        output.checks.append(Check(name="training_never_diverged", passed=False, detail=went_on))
    return output


def _ends(trained: Trained) -> dict[str, Scalar]:
    """First and last recorded loss, and the speed in rays per second if known, by part of the model."""
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
    # Sensors have different loss terms: a missing one is None in the sensor's rows.
    names = dict.fromkeys(name for row in rows for name in row)
    write_table(task.folder / "curve.parquet", {name: [row.get(name) for row in rows] for name in names})
