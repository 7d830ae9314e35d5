"""Training one network of a scene from where it was killed, and what a family of recipes hands back."""

from dataclasses import dataclass, field
from pathlib import Path

from torch import Tensor

from nvsf_core.errors import DivergedError, StoreError
from nvsf_core.recipe import TrainingSpec
from nvsf_core.stages.stage import Scalar, Task
from nvsf_core.stores.checkpoints import load_tensors, save_tensors
from nvsf_core.training.loop import Step, TrainingState, train


@dataclass(frozen=True, slots=True, kw_only=True)
class Trained:
    """What training a scene gave, whatever family of recipes it was."""

    tensors: dict[str, Tensor]
    """All weights."""
    curves: dict[str, list[dict[str, float]]]
    """Part of the model (a sensor, a phase) to its training curve."""
    seconds: float
    """All that it took, preparation included."""
    metadata: dict[str, Scalar]
    """What else is worth knowing, units in the keys."""
    facts: dict[str, object] = field(default_factory=dict)
    """What rendering needs beside the weights."""


def fit(
    task: Task, work: Path, part: str, state: TrainingState, spec: TrainingSpec, step: Step
) -> TrainingState:
    """Train one part of a scene's model, from its checkpoint in `work` where there is one of this recipe.

    Raises:
        DivergedError: A loss or a weight is not finite; scene, recipe, part and step are named.
    """
    recipe = task.config.recipe
    path = work / f"{part}.safetensors"

    def say(line: str) -> None:
        task.progress(f"[{task.scene.name}] field, {part}: {line}")

    def save(tensors: dict[str, Tensor], facts: dict[str, object]) -> None:
        save_tensors(path, tensors, facts | {"recipe": recipe.identity()})

    observe = task.observe
    resume(task, state, path)
    try:
        train(
            state, spec, step, save, say, None if observe is None else lambda seen: observe(part, seen)
        )  # fmt: skip
    except DivergedError as error:
        raise DivergedError(f"scene {task.scene.name}, recipe {recipe.name}, {part}: {error}") from error
    return state


def resume(task: Task, state: TrainingState, path: Path) -> None:
    """Go on from a checkpoint, if there is a readable one of the task's recipe."""
    if not path.is_file():
        return
    try:
        tensors, facts = load_tensors(path)
    except StoreError as error:
        task.progress(f"[{task.scene.name}] field: checkpoint left aside: {error}")
        return
    if facts.get("recipe") == task.config.recipe.identity():
        state.restore(tensors, facts)
        place = f"[{task.scene.name}] field, {path.stem}"
        task.progress(f"{place}: resumed from the checkpoint at step {state.step}")
