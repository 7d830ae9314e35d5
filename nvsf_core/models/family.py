"""Families of recipes: what each trains with and gives, and the choice of a recipe's family.

A new family is a folder with a module `family` and a line in `_MODULES`.
"""

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any, Protocol, cast

import torch
from torch import Tensor, nn

from nvsf_core._types import Say, Scalar
from nvsf_core.errors import RecipeError
from nvsf_core.recipe.base import Recipe
from nvsf_core.recipe.residual import TrainingSpec
from nvsf_core.recording.drive import Recording
from nvsf_core.simulation.scene_model import SceneModel
from nvsf_core.training.loop import Save, Step, TrainingState, train

_MODULES = {
    "residual": "nvsf_core.models.residual.family",
    "paper": "nvsf_core.models.paper.family",
}


def training_device() -> torch.device:
    """CUDA's first visible device, else the CPU; `CUDA_VISIBLE_DEVICES=` keeps a training on the CPU."""
    return torch.device(_kind())


def _kind() -> str:
    return "cuda" if torch.cuda.is_available() else "cpu"


@dataclass(frozen=True, slots=True)
class ResumedPart:
    """One part of a model, restored from its checkpoint if it has one."""

    save: Save
    say: Say
    observe: Callable[[TrainingState], None] | None
    """Called with the state after each step, or None."""


class TrainingSession(Protocol):
    """The training of one scene's model, part by part: its LiDAR, its camera, ..."""

    @property
    def seed(self) -> int:
        """Decides the initial weights and what each step samples."""

    def say(self, part: str, line: str, /) -> None:
        """Print a line of progress of a part."""

    def resumed(self, part: str, state: TrainingState, /) -> AbstractContextManager[ResumedPart]:
        """Context of a part's training; restores `state` from the part's checkpoint if there is one.

        Raises:
            DivergedError: Training inside diverged; scene, recipe and part are added to the message.
        """


def fit(
    session: TrainingSession, part: str, state: TrainingState, spec: TrainingSpec, step: Step
) -> TrainingState:
    """Train one part of a scene's model, from its checkpoint if there is one; returns `state`.

    The model has the mean of its last weights afterwards where `spec` says so.

    Args:
        session: Holds the checkpoints.
        part: Name of the part, for checkpoints and progress lines.
        state: Before the first step.
        spec: Of the loop.
        step: Gives the loss of a step.

    Raises:
        DivergedError: A loss, gradient or weight is not finite; scene, recipe, part and step are named.
    """
    with session.resumed(part, state) as one:
        train(state, spec, step, one.save, one.say, one.observe)
    if state.average is not None and spec.averaged_share > 0.0:
        state.average.put_in_place()
    return state


@dataclass(frozen=True, slots=True, kw_only=True)
class Trained:
    """A trained model of a scene, of any family."""

    tensors: dict[str, Tensor]
    curves: dict[str, list[dict[str, float]]]
    """The training curve of each part of the model (a sensor, a phase)."""
    seconds: float
    """Total time, preparation included."""
    metadata: dict[str, Scalar]
    """Figures for the stage's record, units in the keys."""
    facts: dict[str, object] = field(default_factory=dict)
    """What rendering needs besides the weights, as JSON values."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainedPart:
    """The result of training one part of a model, besides its weights; fields as in `Trained`."""

    states: dict[str, TrainingState]
    """The final state of each training, by the name of its curve."""
    preparation_seconds: float
    """Time besides the training steps, scoring on validation data included."""
    metadata: dict[str, Scalar]
    facts: dict[str, object]
    tensors: dict[str, Tensor] = field(default_factory=dict)
    """What rendering needs besides the networks' weights, by name."""


class Weights(Protocol):
    """A trained model's stored weights and facts."""

    @property
    def facts(self) -> Mapping[str, Any]:
        """`Trained.facts`."""

    def has(self, prefix: str, /) -> bool:
        """Whether any weight's name begins with the prefix."""

    def tensor(self, name: str, /) -> Tensor:
        """The tensor of that name.

        Raises:
            StoreError: It is absent, or a value is not finite.
        """

    def load_into(self, model: nn.Module, prefix: str, /) -> None:
        """Load the weights whose names begin with the prefix into a network, the prefix removed.

        Raises:
            StoreError: Names or shapes do not fit the network, or a weight is not finite.
        """


class Family(Protocol):
    """How the recipes of one family are trained and rendered. A module with these functions is a family."""

    def train(self, recipe: Any, recording: Recording, session: TrainingSession, /) -> Trained:
        """Train, resuming from the session's checkpoints.

        Raises:
            DivergedError: A loss, gradient or weight is not finite.
        """

    def load(
        self, recipe: Any, weights: Weights, recording: Recording, /, *, with_camera: bool = True
    ) -> SceneModel:
        """A trained model, ready to render; without its cameras if only the LiDAR is needed.

        Raises:
            StoreError: The weights do not fit the recipe.
        """


def family_of(recipe: Recipe) -> Family:
    """The family that trains and renders a recipe.

    Raises:
        RecipeError: No family trains such a recipe.
    """
    if recipe.family not in _MODULES:
        known = " or ".join(_MODULES)
        raise RecipeError(f"expected a recipe of the family {known}, found {type(recipe).__name__}")
    return cast(Family, import_module(_MODULES[recipe.family]))
