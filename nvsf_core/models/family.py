"""Families of recipes: the interface of each, and the choice of a recipe's family.

A new family is a folder with a module `family` and a line in `_MODULES`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any, Protocol, cast

from torch import Tensor, nn

from nvsf_core._types import Scalar
from nvsf_core.errors import RecipeError
from nvsf_core.recipe import Recipe
from nvsf_core.recording.drive import Recording
from nvsf_core.simulation.scene_model import SceneModel
from nvsf_core.training.loop import TrainingState
from nvsf_core.training.session import TrainingSession

_MODULES = {
    "residual": "nvsf_core.models.residual.family",
    "paper": "nvsf_core.models.paper.family",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Trained:
    """A trained model of a scene, of any family."""

    tensors: dict[str, Tensor]
    """All weights."""
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
