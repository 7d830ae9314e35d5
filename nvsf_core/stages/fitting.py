"""Training one network of a scene from where it was killed, and what a family of recipes hands back."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from nvsf_core.errors import DivergedError, StoreError
from nvsf_core.recipe import ResidualRecipe, TrainingSpec
from nvsf_core.stages.stage import Scalar, Task
from nvsf_core.stores.checkpoints import load_tensors, save_tensors
from nvsf_core.training.loop import Step, TrainingState, make_optimiser, train


@dataclass(frozen=True, slots=True, kw_only=True)
class Trained:
    """What training a scene gave, whatever family of recipes it was."""

    tensors: dict[str, Tensor]
    """All weights."""
    curves: dict[str, list[dict[str, float]]]
    """Sensor to its training curve."""
    seconds: float
    """All that it took, preparation included."""
    metadata: dict[str, Scalar]
    """What else is worth knowing, units in the keys."""


def fit(
    task: Task, work: Path, sensor: str, model: torch.nn.Module, spec: TrainingSpec, step: Step
) -> TrainingState:
    """Train one network, from its checkpoint in `work` where there is one of this recipe.

    Raises:
        DivergedError: A loss or a weight is not finite; scene, recipe, sensor and step are named.
    """
    recipe = task.config.recipe
    generator = torch.Generator().manual_seed(task.config.seed * 2 + (sensor == "camera"))
    state = TrainingState(model, make_optimiser(model, spec), generator)
    path = work / f"{sensor}.safetensors"

    def say(line: str) -> None:
        task.progress(f"[{task.scene.name}] field, {sensor}: {line}")

    def save(tensors: dict[str, Tensor], facts: dict[str, object]) -> None:
        save_tensors(path, tensors, facts | {"recipe": recipe.identity()})

    _resume(state, path, recipe, say)
    try:
        train(state, spec, step, save, say)
    except DivergedError as error:
        raise DivergedError(f"scene {task.scene.name}, recipe {recipe.name}, {sensor}: {error}") from error
    return state


def _resume(state: TrainingState, path: Path, recipe: ResidualRecipe, say: Callable[[str], None]) -> None:
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
