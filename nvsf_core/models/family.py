"""Families of recipes: what each can do, and the one place where a recipe's family is chosen.

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
from nvsf_core.training.session import TrainingSession

_MODULES = {
    "residual": "nvsf_core.models.residual.family",
    "paper": "nvsf_core.models.paper.family",
}


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


class Weights(Protocol):
    """A trained model's weights and facts, wherever they are kept."""

    @property
    def facts(self) -> Mapping[str, Any]:
        """As of `Trained`."""

    def has(self, prefix: str, /) -> bool:
        """Whether any weight's name begins so."""

    def load_into(self, model: nn.Module, prefix: str, /) -> None:
        """Give a network the weights whose names begin with a prefix, which is taken off.

        Raises:
            StoreError: Names or shapes are not the network's, or a weight is not finite.
        """


class Family(Protocol):
    """How the recipes of one family are trained and rendered; a module with these functions is one."""

    def needs(self, recipe: Any, recording: Recording, /) -> dict[str, Scalar]:
        """What the recipe allocates for a scene, before it is trained; empty where no size is the scene's."""

    def train(self, recipe: Any, recording: Recording, session: TrainingSession, /) -> Trained:
        """Train, resuming from the session's checkpoints.

        Raises:
            DivergedError: A loss, gradient or weight is not finite.
        """

    def load(
        self, recipe: Any, weights: Weights, recording: Recording, /, *, with_camera: bool = True
    ) -> SceneModel:
        """A trained model, ready to render; without its cameras where only the LiDAR is asked.

        Raises:
            StoreError: The weights are not the recipe's.
        """


def family_of(recipe: Recipe) -> Family:
    """The family that trains and renders a recipe.

    Raises:
        RecipeError: Nothing here trains such a recipe.
    """
    if recipe.family not in _MODULES:
        known = " or ".join(_MODULES)
        raise RecipeError(f"expected a recipe of the family {known}, found {type(recipe).__name__}")
    return cast(Family, import_module(_MODULES[recipe.family]))
