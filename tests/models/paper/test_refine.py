"""Laws of the refinement phase."""

import pytest
import torch
from torch import nn
from torch.nn.functional import binary_cross_entropy_with_logits

from nvsf_core.errors import DivergedError, ShapeError
from nvsf_core.fields.raydrop_unet import RaydropUnet
from nvsf_core.models.paper.refine import (
    blanked_boxes,
    one_cycle,
    refine,
    refinement_state,
)
from nvsf_core.recipe.paper import RefinementSpec
from nvsf_core.stores.checkpoints import load_tensors, save_tensors
from nvsf_core.training.loop import TrainingState

SPEC = RefinementSpec(steps=16, rate=1e-2)


class Tiny(nn.Module):
    """A convolution with a drop-out, so that resuming has to remember its draws."""

    def __init__(self) -> None:
        super().__init__()
        self.first, self.last = nn.Conv2d(3, 4, 3, padding=1), nn.Conv2d(4, 1, 1)
        self.dropout = nn.Dropout2d(0.2)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.last(self.dropout(torch.relu(self.first(x))))[:, 0]


def panos(n: int = 3, height: int = 16, width: int = 40) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns where the range is odd, which the given hit probability does not know."""
    generator = torch.Generator().manual_seed(5)
    renders = torch.rand(n, 3, height, width, generator=generator)
    return renders, renders[:, 2] > 0.5


def fresh(spec: RefinementSpec = SPEC) -> TrainingState:
    generator = torch.Generator().manual_seed(3)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = Tiny()
    return refinement_state(model, spec, generator)


def ignore(*_: object) -> None:
    """Neither saved nor said."""


def test_one_cycle_is_torchs() -> None:
    for steps in (4, 30, 1000):
        parameter = nn.Parameter(torch.zeros(1))
        optimiser = torch.optim.Adam([parameter], lr=1.0)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 1e-3, total_steps=steps)
        for step in range(steps):
            group = optimiser.param_groups[0]
            assert one_cycle(step, steps, 1e-3) == pytest.approx((group["lr"], group["betas"][0]), rel=1e-9)
            optimiser.step()
            if step < steps - 1:
                schedule.step()
    assert one_cycle(0, 1, 1e-3)[0] > 0.0


def test_it_learns_what_the_renders_know() -> None:
    renders, is_return = panos()
    spec = RefinementSpec(steps=100, rate=5e-2)
    state = fresh(spec)
    refine(state, spec, renders, is_return, ignore, ignore)
    refined = torch.sigmoid(state.model(renders))
    assert ((refined > 0.5) == is_return).float().mean() > 0.9
    assert state.curve[-1]["loss"] < 0.8 * state.curve[0]["loss"]


def test_gradients_of_frames_add_up_to_the_whole() -> None:
    renders, is_return = panos()
    spec = RefinementSpec(steps=1, rate=1e-2)
    state, whole = fresh(spec), fresh(spec)
    state.model.dropout.p = whole.model.dropout.p = 0.0
    refine(state, spec, renders, is_return, ignore, ignore)
    blank = blanked_boxes(*renders.shape[2:], whole.generator)
    logits = whole.model(renders.masked_fill(blank, 0.0))
    loss = binary_cross_entropy_with_logits(logits, is_return.float())
    loss.backward()
    assert torch.allclose(state.model.first.weight.grad, whole.model.first.weight.grad, atol=1e-6)
    assert state.curve[0]["loss"] == pytest.approx(float(loss.detach()), rel=1e-5)


def test_frames_are_taken_in_turn() -> None:
    renders, is_return = panos(3)
    seen = []
    spec = RefinementSpec(steps=3, frames_a_step=2)
    state = fresh(spec)
    state.model.register_forward_pre_hook(lambda _, args: seen.append(float(args[0][0, 2].max())))
    renders[:, 2] = torch.tensor([1.0, 2.0, 3.0])[:, None, None]
    refine(state, spec, renders, is_return, ignore, ignore)
    assert seen == [1.0, 2.0, 3.0, 1.0, 2.0, 3.0]


def test_a_killed_and_resumed_refinement_gives_the_same_bits(tmp_path) -> None:
    renders, is_return = panos()
    whole = fresh()
    refine(whole, SPEC, renders, is_return, ignore, ignore)

    class Killed(Exception):
        pass

    path = tmp_path / "checkpoint.safetensors"

    def save_then_die(tensors, facts) -> None:
        save_tensors(path, tensors, facts)
        if facts["step"] == 11:
            raise Killed

    with pytest.raises(Killed):
        refine(fresh(), SPEC, renders, is_return, save_then_die, ignore, checkpoint_s=0.0)
    resumed = fresh()
    resumed.restore(*load_tensors(path))
    assert resumed.step == 11
    torch.manual_seed(99)
    refine(resumed, SPEC, renders, is_return, ignore, ignore)
    for name, value in whole.model.state_dict().items():
        assert torch.equal(value, resumed.model.state_dict()[name]), name


def test_the_papers_unet_is_refined_and_resumed_too() -> None:
    renders, is_return = panos(2, 33, 50)
    spec = RefinementSpec(channels=8, steps=4, frames_a_step=1)
    states = []
    for stop in (None, 2):
        state = refinement_state(
            RaydropUnet(spec.channels, torch.Generator().manual_seed(1)),
            spec,
            torch.Generator().manual_seed(2),
        )
        kept = {}

        def keep(tensors, facts, kept=kept) -> None:
            kept[facts["step"]] = {name: value.clone() for name, value in tensors.items()}, dict(facts)

        refine(state, spec, renders, is_return, keep, ignore, checkpoint_s=0.0)
        if stop is not None:
            state.restore(*kept[stop])
            refine(state, spec, renders, is_return, ignore, ignore)
        states.append(state.model.state_dict())
    assert all(torch.equal(states[0][name], states[1][name]) for name in states[0])
    refined = torch.sigmoid(state.model(renders))
    assert refined.shape == (2, 33, 50) and (refined >= 0).all() and (refined <= 1).all()


def test_blanked_boxes_are_small_and_sometimes_none() -> None:
    generator = torch.Generator().manual_seed(0)
    shares = torch.tensor([blanked_boxes(66, 1030, generator).float().mean() for _ in range(200)])
    assert shares.min() == 0.0
    assert 31 * 5 * 102 / (66 * 1030) >= shares.max() > 0.02
    assert blanked_boxes(4, 6, generator).shape == (4, 6)


def test_blanked_inputs_are_zero_in_all_channels() -> None:
    renders, is_return = panos()
    state = fresh()
    inputs = []
    state.model.register_forward_pre_hook(lambda _, args: inputs.append(args[0]))
    refine(state, SPEC, renders + 1.0, is_return, ignore, ignore)
    images = torch.cat(inputs)
    blank = images[:, 0] == 0.0
    assert blank.any() and not blank.all()
    assert (images[:, 1][blank] == 0.0).all() and (images[:, 2][blank] == 0.0).all()
    assert torch.equal(blank[0], blank[1])


def test_what_cannot_be_refined_is_named() -> None:
    renders, is_return = panos()
    with pytest.raises(ShapeError):
        refine(fresh(), SPEC, renders[:0], is_return[:0], ignore, ignore)
    with pytest.raises(ShapeError):
        refine(fresh(), SPEC, renders, is_return[:, :3], ignore, ignore)
    with pytest.raises(DivergedError, match="renders"):
        refine(fresh(), SPEC, renders * torch.nan, is_return, ignore, ignore)
    broken = fresh()
    with torch.no_grad():
        broken.model.last.bias.fill_(torch.inf)
    with pytest.raises(DivergedError, match="step 0: loss term 'hit'"):
        refine(broken, SPEC, renders, is_return, ignore, ignore)
