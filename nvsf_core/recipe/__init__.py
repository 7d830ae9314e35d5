"""What a run does: frozen recipes, read from and written to JSON, never changed in place."""

from nvsf_core.recipe.base import Recipe
from nvsf_core.recipe.paper import (
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
    ReferenceQuirks,
    RefinementSpec,
    TimeGridSpec,
)
from nvsf_core.recipe.presets import ABLATION, ENCODINGS, preset, recipe_from_json
from nvsf_core.recipe.residual import (
    CameraSpec,
    EvidenceSpec,
    FieldSpec,
    HitsSpec,
    LossWeights,
    PanoSpec,
    ResidualRecipe,
    TrainingSpec,
)
from nvsf_core.recipe.seed import MOST_SEED, is_seed_folder, require_seed, seed_from_text
from nvsf_core.recipe.slower import differ_in_step_size, full_name, share_of, slower

__all__ = [
    "ABLATION",
    "ENCODINGS",
    "MOST_SEED",
    "CameraSpec",
    "EncoderSpec",
    "EvidenceSpec",
    "FieldSpec",
    "FlowSpec",
    "GradientLossSpec",
    "GridSpec",
    "HeadsSpec",
    "HitsSpec",
    "LossWeights",
    "PanoSpec",
    "PaperLosses",
    "PaperOptimiser",
    "PaperRecipe",
    "PaperSampling",
    "PlanesSpec",
    "Recipe",
    "ReferenceQuirks",
    "RefinementSpec",
    "ResidualRecipe",
    "TimeGridSpec",
    "TrainingSpec",
    "differ_in_step_size",
    "full_name",
    "is_seed_folder",
    "preset",
    "recipe_from_json",
    "require_seed",
    "seed_from_text",
    "share_of",
    "slower",
]
