"""What a run does: frozen presets, read from and written to JSON, never changed in place."""

from nvsf_core.recipe.paper import (
    AuthorsSlips,
    EncoderSpec,
    FlowSpec,
    GradientLossSpec,
    GridSpec,
    HeadsSpec,
    PaperLosses,
    PaperOptimiser,
    PaperRecipe,
    PaperSampling,
    PlanesSpec,
    RefinementSpec,
    TimeGridSpec,
)
from nvsf_core.recipe.residual import (
    BackgroundSpec,
    EvidenceSpec,
    FieldSpec,
    LossWeights,
    Recipe,
    TrainingSpec,
)

__all__ = [
    "AuthorsSlips",
    "BackgroundSpec",
    "EncoderSpec",
    "EvidenceSpec",
    "FieldSpec",
    "FlowSpec",
    "GradientLossSpec",
    "GridSpec",
    "HeadsSpec",
    "LossWeights",
    "PaperLosses",
    "PaperOptimiser",
    "PaperRecipe",
    "PaperSampling",
    "PlanesSpec",
    "Recipe",
    "RefinementSpec",
    "TimeGridSpec",
    "TrainingSpec",
]
