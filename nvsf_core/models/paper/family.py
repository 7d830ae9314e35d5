"""The family `paper` (recipes `paper`, `paper_cpu`, ...); implements `Family`."""

from nvsf_core._types import Scalar
from nvsf_core.models.paper.scene import load
from nvsf_core.models.paper.training.train import train
from nvsf_core.recipe import PaperRecipe
from nvsf_core.recording.drive import Recording

__all__ = ["load", "needs", "train"]


def needs(recipe: PaperRecipe, recording: Recording) -> dict[str, Scalar]:
    """Nothing: the recipe's field has the same size for every scene."""
    del recipe, recording
    return {}
