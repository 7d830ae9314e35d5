"""A recipe with a wrong value cannot be made: its field, what it must be and what it was are named."""

from dataclasses import fields, replace
from types import ModuleType
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import pytest

from nvsf_core.errors import RecipeError
from nvsf_core.recipe import paper, residual
from nvsf_core.recipe.bounds import Spec
from nvsf_core.recipe.paper import (
    GradientLossSpec,
    GridSpec,
    PaperOptimiser,
    PaperRecipe,
    PaperSampling,
    PlanesSpec,
    RefinementSpec,
    TimeGridSpec,
)
from nvsf_core.recipe.presets import preset, preset_names, recipe_from_json
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

NAN, INFINITY = float("nan"), float("inf")
NEEDED: dict[type[Spec], dict[str, Any]] = {
    GridSpec: {"levels": 2, "features": 4, "log2_table": 8, "base_resolution": 16, "finest_resolution": 64},
    HitsSpec: {"training": TrainingSpec(steps=20, rays=256)},
    PaperRecipe: {"name": "mine"},
    ResidualRecipe: {"name": "mine"},
    TrainingSpec: {"steps": 20, "rays": 256},
}
"""Valid values of the fields that have no default."""


@pytest.mark.parametrize(
    ("kind", "wrong", "expected"),
    [
        (EvidenceSpec, {"votes": 0}, "a whole number of at least 1"),
        (EvidenceSpec, {"votes": -3}, "a whole number of at least 1"),
        (EvidenceSpec, {"lidar_candidates": 0}, "a whole number of at least 1"),
        (EvidenceSpec, {"lidar_candidates": True}, "a whole number of at least 1"),
        (FieldSpec, {"levels": 0}, "a whole number from 1 to 64"),
        (FieldSpec, {"max_shift_m": -1.0}, "a finite number of at least 0"),
        (CameraSpec, {"sources": 0}, "a whole number of at least 1"),
        (CameraSpec, {"planes": 1}, "a whole number of at least 2"),
        (CameraSpec, {"near_m": 0.0}, "a finite number above 0"),
        (CameraSpec, {"judge_every": 1}, "a whole number of at least 2"),
        (CameraSpec, {"plane_px": 1}, "a whole number of at least 64"),
        (CameraSpec, {"aligned": 1}, "a boolean"),
        (CameraSpec, {"depth_channels": [12, 16]}, "a tuple of 2 values, each a whole number"),
        (CameraSpec, {"depth_channels": (12, 0)}, "a tuple of 2 values, each a whole number"),
        (TrainingSpec, {"steps": 0}, "a whole number of at least 1"),
        (TrainingSpec, {"steps": 20.0}, "a whole number of at least 1"),
        (TrainingSpec, {"rays": 0}, "a whole number of at least 1"),
        (TrainingSpec, {"parts": 0}, "a whole number of at least 1"),
        (TrainingSpec, {"table_rate": -0.02}, "a finite number above 0"),
        (TrainingSpec, {"network_rate": NAN}, "a finite number above 0"),
        (TrainingSpec, {"final_share": 0.0}, "a finite number above 0 and at most 1"),
        (TrainingSpec, {"averaged_share": 2.0}, "a finite number from 0 to 1"),
        (LossWeights, {"hit": INFINITY}, "a finite number"),
        (LossWeights, {"hit": 10**400}, "a finite number"),
        (PanoSpec, {"frames": 1}, "a whole number of at least 2"),
        (HitsSpec, {"training": None}, "TrainingSpec"),
        (GridSpec, {"log2_table": 31}, "a whole number from 1 to 30"),
        (TimeGridSpec, {"base_resolution": 2**21}, "a whole number from 2 to 1048576"),
        (PlanesSpec, {"scales": ()}, "a tuple of one or more values"),
        (PlanesSpec, {"scales": (1, 0)}, "a tuple of one or more values"),
        (PaperSampling, {"near_m": -1.0}, "a finite number of at least 0"),
        (PaperSampling, {"patches": (2, 8, 1)}, "a tuple of 2 values.* or None"),
        (GradientLossSpec, {"mask": "triple"}, "one of double, single"),
        (RefinementSpec, {"channels": -1}, "a whole number of at least 0"),
        (PaperOptimiser, {"ema_decay": 1.5}, "a finite number from 0 to 1"),
        (ResidualRecipe, {"evidence": "none"}, "EvidenceSpec"),
        (ResidualRecipe, {"hits": 3}, "HitsSpec or None"),
        (PaperRecipe, {"encoders": "none"}, "one of same, separate, separate_fused"),
    ],
)
def test_a_wrong_value_is_refused_by_its_fields_name(
    kind: type[Spec], wrong: dict[str, Any], expected: str
) -> None:
    (field,) = wrong
    with pytest.raises(RecipeError, match=rf"{kind.__name__}\.{field}: expected {expected}.*, found "):
        kind(**NEEDED.get(kind, {}) | wrong)


@pytest.mark.parametrize(
    ("kind", "wrong", "said"),
    [
        (CameraSpec, {"near_m": 400.0}, "CameraSpec: expected near_m < far_m, found 400.0 and 300.0"),
        (PaperSampling, {"far_m": 1.0}, "PaperSampling: expected near_m < far_m, found 1.0 and 1.0"),
        (FieldSpec, {"finest_cell_m": 9.0}, "expected finest_cell_m <= coarsest_cell_m, found 9.0 and 4.0"),
        (GridSpec, {"finest_resolution": 8}, "expected base_resolution <= finest_resolution"),
    ],
)
def test_two_values_that_contradict_each_other_are_refused(
    kind: type[Spec], wrong: dict[str, Any], said: str
) -> None:
    with pytest.raises(RecipeError, match=said):
        kind(**NEEDED.get(kind, {}) | wrong)


def test_each_part_of_a_lidar_step_needs_a_ray() -> None:
    quick = preset("quick")
    assert isinstance(quick, ResidualRecipe)
    with pytest.raises(RecipeError, match=r"lidar_training: expected .* found 1 and 2"):
        replace(quick, lidar_training=replace(quick.lidar_training, rays=1, parts=2))


@pytest.mark.parametrize("name", preset_names())
def test_every_preset_and_one_with_smaller_steps_is_valid_and_is_read_back(name: str) -> None:
    for recipe in (preset(name), preset(f"{name}@0.5")):
        assert recipe_from_json(recipe.to_json()) == recipe


@pytest.mark.parametrize("module", [residual, paper])
def test_every_number_of_a_recipe_has_bounds(module: ModuleType) -> None:
    specs = [one for one in vars(module).values() if isinstance(one, type) and issubclass(one, Spec)]
    kinds = {
        f"{spec.__name__}.{field.name}": get_type_hints(spec, include_extras=True)[field.name]
        for spec in specs
        for field in fields(spec)
    }
    assert len(kinds) > 40
    assert [name for name, kind in kinds.items() if not _is_bounded(kind)] == []


def _is_bounded(kind: Any) -> bool:
    if get_origin(kind) is Annotated:
        return True
    return kind not in (int, float) and all(_is_bounded(part) for part in get_args(kind))
