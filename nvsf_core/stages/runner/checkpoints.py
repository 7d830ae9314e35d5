"""Training one network of a scene from where it was killed, and what a family of recipes hands back."""

import shutil
from dataclasses import dataclass, field
from pathlib import Path

from torch import Tensor

from nvsf_core._types import Scalar
from nvsf_core.errors import StoreError
from nvsf_core.recipe import TrainingSpec
from nvsf_core.stages.runner.divergence import diverging, owner
from nvsf_core.stages.runner.stage import Task
from nvsf_core.stores.checkpoints import load_tensors, save_tensors
from nvsf_core.training.loop import Save, Step, TrainingState, train


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
        DivergedError: A loss, gradient or weight is not finite; scene, recipe, part and step are named.
    """
    path = work / f"{part}.safetensors"

    def say(line: str) -> None:
        task.progress(f"[{task.scene.name}] field, {part}: {line}")

    observe = task.observe
    resume(task, state, path)
    with diverging(task, work, part):
        train(
            state, spec, step, saving(task, path), say,
            None if observe is None else lambda seen: observe(part, seen),
        )  # fmt: skip
    return state


def saving(task: Task, path: Path) -> Save:
    """Writes a checkpoint that only a training of the same recipe on the same inputs goes on from."""

    def save(tensors: dict[str, Tensor], facts: dict[str, object]) -> None:
        save_tensors(path, tensors, facts | owner(task, task.config.recipe))

    return save


def resume(task: Task, state: TrainingState, path: Path) -> None:
    """Go on from a checkpoint, if there is a readable one of the task's recipe and inputs."""
    if path.is_dir():
        shutil.rmtree(path)  # it would refuse the first checkpoint, after minutes
    if not path.is_file():
        return
    place = f"[{task.scene.name}] field, {path.stem}"
    try:
        tensors, facts = load_tensors(path)
    except StoreError as error:
        task.progress(f"{place}: checkpoint left aside: {error}")
        return
    if any(facts.get(name) != value for name, value in owner(task, task.config.recipe).items()):
        task.progress(f"{place}: checkpoint left aside: of another recipe or of other inputs")
        return
    try:
        state.restore(tensors, facts)
    except StoreError as error:
        task.progress(f"{place}: checkpoint left aside: {error}")
        return
    task.progress(f"{place}: resumed from the checkpoint at step {state.step}")
