"""Every preset has a family that trains and renders it; what a family's parts are trained by."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import ClassVar

import pytest
import torch
from torch import Tensor, nn

from nvsf_core.errors import RecipeError
from nvsf_core.losses.total import total_loss
from nvsf_core.models.family import ResumedPart, family_of, fit
from nvsf_core.recipe.base import Recipe
from nvsf_core.recipe.presets import ABLATION, ENCODINGS, preset
from nvsf_core.recipe.residual import TrainingSpec
from nvsf_core.training.loop import Step, TrainingState, fresh_state

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


class _Session:
    """A training session that keeps the last checkpoint in memory."""

    seed = 0

    def __init__(self) -> None:
        self.saved: tuple[dict[str, Tensor], dict[str, object]] | None = None

    def say(self, part: str, line: str, /) -> None:
        """Say nothing."""

    def _save(self, tensors: dict[str, Tensor], facts: dict[str, object]) -> None:
        self.saved = {name: value.clone() for name, value in tensors.items()}, facts

    @contextmanager
    def resumed(self, part: str, state: TrainingState, /) -> Iterator[ResumedPart]:
        if self.saved is not None:
            state.restore(*self.saved)
        yield ResumedPart(save=self._save, say=lambda _: None, observe=None)


def test_a_finished_part_has_its_averaged_weights_and_again_when_it_is_resumed():
    spec = TrainingSpec(steps=30, rays=4, averaged_share=1.0)
    session, found = _Session(), []
    for _ in range(2):
        model = nn.Linear(1, 1, bias=False)
        with torch.no_grad():
            model.weight.fill_(1.0)
        state = fresh_state(model, spec, 0)
        fit(session, "part", state, spec, _pulled_down(model))
        found.append(model.weight.item())
        assert session.saved is not None
        assert session.saved[0]["model.weight"].item() < found[-1] < 1.0
    assert found[0] == found[1]


def _pulled_down(model: nn.Linear) -> Step:
    return lambda *_: [lambda: [total_loss({"weight": model.weight[0]}, {"weight": 1.0})]]
