"""Recipes go through JSON unchanged, and are what their names say."""

import json
from dataclasses import replace

import pytest

from nvsf_core.errors import RecipeError
from nvsf_core.recipe.paper import PaperRecipe
from nvsf_core.recipe.presets import ABLATION, ENCODINGS, preset, recipe_from_json
from nvsf_core.recipe.residual import ResidualRecipe

PAPER_NAMES = ("paper", "paper_authors", "paper_cpu", "paper_same", "paper_separate_fused")
NAMES = ("lean", "quick", "smoke", *PAPER_NAMES)


@pytest.mark.parametrize("name", [*NAMES, *(recipe.name for recipe in ABLATION + ENCODINGS)])
def test_a_preset_survives_json(name):
    recipe = preset(name)
    again = recipe_from_json(json.loads(json.dumps(recipe.to_json())))
    assert again == recipe
    assert again.identity() == recipe.identity()


def test_any_changed_switch_changes_the_identity():
    paper = preset("paper")
    assert isinstance(paper, PaperRecipe)
    changed = (
        replace(paper, aggregate=False),
        replace(paper, slips=replace(paper.slips, bound=2.0)),
        replace(paper, sampling=replace(paper.sampling, patches=None)),
        replace(paper, losses=replace(paper.losses, gradient=0.1)),
    )
    assert len({recipe.identity() for recipe in (paper, *changed)}) == 5


def test_ablation_rows_differ_from_the_baseline_in_one_thing_each():
    rows = {recipe.name.removeprefix("paper_cpu_"): recipe for recipe in ABLATION}
    base = rows["bl"]
    assert replace(base, sampling=rows["bl_hs"].sampling, name=rows["bl_hs"].name) == rows["bl_hs"]
    assert rows["bl_hs"].sampling == replace(base.sampling, heuristic=True)
    assert replace(base, gradient=rows["bl_fa"].gradient, name=rows["bl_fa"].name) == rows["bl_fa"]
    assert rows["bl_fa"].gradient.mask == "double"
    assert rows["bl_ml"].sampling == replace(base.sampling, camera=True)
    assert rows["all"].sampling == replace(base.sampling, camera=True, heuristic=True)


def test_an_unknown_name_lists_the_known_ones():
    with pytest.raises(RecipeError, match=r"no recipe 'fast'; there are .*paper_cpu.*quick"):
        preset("fast")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"family": "other"}, "found 'other'"),
        ({"colour_of_the_car": 1}, "colour_of_the_car"),
        ({"evidence": 3}, "EvidenceSpec"),
    ],
)
def test_json_of_something_else_is_refused(change, message):
    with pytest.raises(RecipeError, match=message):
        recipe_from_json(preset("quick").to_json() | change)


def test_a_stored_recipe_with_a_switch_that_is_gone_is_refused_by_its_name():
    values = preset("paper").to_json()
    values["slips"]["active_sensor"] = False
    with pytest.raises(RecipeError, match=r"no recipe of this version.*active_sensor.*train again"):
        recipe_from_json(values)


def test_a_family_does_not_read_the_other_ones_json():
    with pytest.raises(RecipeError, match="family residual"):
        ResidualRecipe.from_json(preset("paper").to_json())


@pytest.mark.parametrize(
    ("part", "name", "value"),
    [
        ("hits", "layers", 8.4), ("hits", "layers", True), ("lidar_training", "steps", "20"),
        ("losses", "depth", "heavy"), ("camera", "aligned", 1), ("lidar_field", "levels", None),
    ],
)  # fmt: skip
def test_a_value_of_another_kind_is_refused_by_name(part, name, value):
    values = preset("lean").to_json()
    values[part][name] = value
    with pytest.raises(RecipeError, match="expected a"):
        recipe_from_json(values)


def test_whole_numbers_are_floats_too():
    values = preset("lean").to_json()
    values["losses"]["depth"] = 2
    assert recipe_from_json(values).losses.depth == 2
