"""Every preset has a family that trains and renders it; an unknown one is refused by name."""

from dataclasses import dataclass
from typing import ClassVar

import pytest

from nvsf_core.errors import RecipeError
from nvsf_core.models.family import family_of
from nvsf_core.recipe import ABLATION, ENCODINGS, Recipe, preset

NAMES = ("lean", "quick", "smoke", "paper", "paper_cpu", "paper_smoke")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Unknown(Recipe):
    family: ClassVar[str] = "splats"


@pytest.mark.parametrize("recipe", [*map(preset, NAMES), *ABLATION, *ENCODINGS], ids=lambda one: one.name)
def test_a_recipe_s_family_trains_and_loads(recipe):
    family = family_of(recipe)
    assert all(callable(getattr(family, name)) for name in ("train", "load"))


def test_a_family_that_nobody_wrote_is_refused():
    with pytest.raises(
        RecipeError, match="expected a recipe of the family residual or paper, found _Unknown"
    ):
        family_of(_Unknown(name="other"))
