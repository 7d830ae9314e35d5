"""Laws of the training loop: killed and resumed is the same as never killed."""

import time
from dataclasses import replace

import pytest
import torch
from torch import nn

from nvsf_core.errors import DivergedError
from nvsf_core.losses.total import LossBreakdown, total_loss
from nvsf_core.recipe.residual import TrainingSpec
from nvsf_core.stores.checkpoints import load_tensors, save_tensors
from nvsf_core.training import loop
from nvsf_core.training.loop import Part, TrainingState, make_optimiser, side_by_side, train
from nvsf_core.training.weight_average import WeightAverage

SPEC = TrainingSpec(steps=40, rays=8, checkpoint_s=0.0)


AVERAGED = replace(SPEC, averaged_share=0.75)


def fresh_state(spec: TrainingSpec = SPEC) -> TrainingState:
    model = nn.Linear(4, 1)
    with torch.no_grad():
        model.weight.fill_(0.1)
        model.bias.zero_()
    return loop.fresh_state(model, spec, 3)


def step_of(state: TrainingState):
    def step(_: int, generator: torch.Generator) -> list[Part]:
        x = torch.randn(8, 4, generator=generator)
        return [lambda: [total_loss({"fit": (state.model(x)[:, 0] - x.sum(dim=1)) ** 2}, {"fit": 1.0})]]

    return step


def ignore(*_: object) -> None:
    """Neither saved nor said."""


@pytest.mark.parametrize("spec", [SPEC, AVERAGED])
def test_a_killed_and_resumed_run_gives_the_same_bits(tmp_path, spec: TrainingSpec) -> None:
    whole = fresh_state(spec)
    train(whole, spec, step_of(whole), ignore, ignore)

    class Killed(Exception):
        pass

    broken = fresh_state(spec)
    path = tmp_path / "checkpoint.safetensors"

    def save_then_die(tensors, facts) -> None:
        save_tensors(path, tensors, facts)
        if facts["step"] == 17:
            raise Killed

    with pytest.raises(Killed):
        train(broken, spec, step_of(broken), save_then_die, ignore)
    resumed = fresh_state(spec)
    resumed.restore(*load_tensors(path))
    assert resumed.step == 17
    train(resumed, spec, step_of(resumed), ignore, ignore)
    assert torch.equal(resumed.model.weight, whole.model.weight)
    assert torch.equal(resumed.model.bias, whole.model.bias)
    assert torch.equal(resumed.generator.get_state(), whole.generator.get_state())
    if whole.average is not None and resumed.average is not None:
        with whole.average.in_place(), resumed.average.in_place():
            assert torch.equal(resumed.model.weight, whole.model.weight)


def test_the_last_weights_are_averaged_from_their_share_on() -> None:
    state, seen = fresh_state(AVERAGED), {}

    def note(now: TrainingState) -> None:
        seen[now.step] = now.model.weight.detach().clone()

    train(state, AVERAGED, step_of(state), ignore, ignore, note)
    assert state.average is not None
    last = [seen[step] for step in (20, 30, 40)]
    assert not torch.equal(last[0], last[2])
    with state.average.in_place():
        torch.testing.assert_close(state.model.weight, torch.stack(last).mean(dim=0))
    assert torch.equal(state.model.weight, last[2])


def test_training_lowers_the_loss() -> None:
    def expected_loss(state: TrainingState) -> float:  # over all rows; batches of eight differ by more
        weight, bias = state.model.weight.detach(), state.model.bias.detach()
        return float((weight - 1.0).square().sum() + bias.square().sum())

    state = fresh_state()
    before = expected_loss(state)
    train(state, SPEC, step_of(state), ignore, ignore)
    assert expected_loss(state) < 0.98 * before


@pytest.mark.parametrize(("steps", "recorded"), [(1, 1), (20, 20), (99, 99), (100, 10), (125, 13)])
def test_a_short_training_records_every_step_as_one_of_ten_says_nothing_of_its_trend(
    steps: int, recorded: int
) -> None:
    state, spec = fresh_state(), TrainingSpec(steps=steps, rays=8, final_share=0.05, checkpoint_s=1e9)
    train(state, spec, step_of(state), ignore, ignore)
    assert len(state.curve) == recorded and state.curve[-1]["step"] == steps


@pytest.mark.parametrize("steps", [1, 2, 1250])
def test_rates_fall_evenly_in_their_logarithm_from_the_full_one(steps: int) -> None:
    spec, seen = TrainingSpec(steps=steps, rays=8, final_share=0.05, checkpoint_s=1e9), []
    state = fresh_state()
    state.optimiser = make_optimiser(state.model, spec)

    def step(_: int, __: torch.Generator) -> list[Part]:
        seen.append(state.optimiser.param_groups[-1]["lr"] / spec.network_rate)
        return []

    train(state, spec, step, ignore, ignore)
    assert seen == pytest.approx([0.05 ** (k / steps) for k in range(steps)], rel=1e-12)


def test_a_nan_names_step_and_term_and_saves_nothing() -> None:
    state = fresh_state()
    saved = []

    def step(number: int, generator: torch.Generator) -> list[Part]:
        broken = torch.full((2, 4), torch.nan)
        return [lambda: [total_loss({"fit": state.model(broken)[:, 0]}, {"fit": 1.0})]]

    with pytest.raises(DivergedError, match=r"step 0: loss term 'fit'"):
        train(state, SPEC, step, lambda tensors, facts: saved.append(facts), ignore)
    assert not saved


def test_weights_that_are_not_finite_are_never_saved() -> None:
    state = fresh_state()
    with torch.no_grad():
        state.model.bias.fill_(torch.inf)

    def step(number: int, generator: torch.Generator) -> list[Part]:
        return [lambda: [total_loss({"fit": state.model.weight.sum()[None]}, {"fit": 1.0})]]

    with pytest.raises(DivergedError, match="bias"):
        train(state, SPEC, step, ignore, ignore)


def test_gradients_of_any_memory_layout_move_the_weights_they_belong_to() -> None:
    """Channels-last convolutions and sums give gradients with other strides than their weights'."""

    class Blurred(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            torch.manual_seed(5)
            self.layer, self.gain = nn.Conv2d(3, 4, 3), nn.Parameter(torch.full((6,), 0.5))

        def forward(self, x: torch.Tensor) -> torch.Tensor:
            return (
                self.layer(x.contiguous(memory_format=torch.channels_last)).square().mean() * self.gain.sum()
            )

    x = torch.randn(2, 3, 9, 9, generator=torch.Generator().manual_seed(1))
    model, expected, spec = Blurred(), Blurred(), TrainingSpec(steps=1, rays=8, checkpoint_s=1e9)
    state = TrainingState(model, make_optimiser(model, spec), torch.Generator())
    train(
        state, spec, lambda *_: [lambda: [total_loss({"fit": model(x)[None]}, {"fit": 1.0})]], ignore, ignore
    )
    expected(x).backward()
    for group in make_optimiser(expected, spec).param_groups:
        for weight in group["params"]:
            # Adam's first step moves every weight by the rate, against its gradient.
            weight.data -= group["lr"] * weight.grad.sign()
    for name, weight in expected.named_parameters():
        assert torch.allclose(model.get_parameter(name), weight, atol=1e-6), name


def test_the_parts_of_a_step_add_up_to_the_whole() -> None:
    whole, parted = fresh_state(), fresh_state()

    def loss(part: torch.Tensor) -> LossBreakdown:
        return total_loss({"fit": (parted.model(part)[:, 0] - part.sum(dim=1)) ** 2}, {"fit": 1.0})

    def in_parts(_: int, generator: torch.Generator) -> list[Part]:
        x = torch.randn(8, 4, generator=generator)
        # One part of two losses, one after the other, and one that another thread may compute.
        return [
            lambda: [loss(x[:2]).scaled(0.25), loss(x[2:4]).scaled(0.25)],
            lambda: [loss(x[4:]).scaled(0.5)],
        ]

    train(whole, SPEC, step_of(whole), ignore, ignore)
    train(parted, SPEC, in_parts, ignore, ignore)
    assert torch.allclose(parted.model.weight, whole.model.weight, atol=1e-5)


def test_parts_side_by_side_are_the_mean_of_their_own_draws() -> None:
    drawn: list[float] = []

    def loss(own: torch.Generator) -> LossBreakdown:
        drawn.append(float(torch.rand((), generator=own)))
        return total_loss({"fit": torch.tensor([drawn[-1]])}, {"fit": 1.0})

    parts = [part() for part in side_by_side(3, torch.Generator().manual_seed(0), loss)]
    assert len(set(drawn)) == 3
    assert sum(float(one.total) for part in parts for one in part) == pytest.approx(sum(drawn) / 3)
    assert sum(one.terms["fit"] for part in parts for one in part) == pytest.approx(sum(drawn) / 3)
    again = [part() for part in side_by_side(3, torch.Generator().manual_seed(0), loss)]
    assert drawn[3:] == drawn[:3] and len(again) == 3


def test_the_averaged_weights_survive_a_checkpoint(tmp_path) -> None:
    state = fresh_state()
    state.average = WeightAverage(state.model, 0.95)
    train(state, SPEC, step_of(state), ignore, ignore)
    state.average.update()
    path = tmp_path / "checkpoint.safetensors"
    save_tensors(path, state.tensors(), state.facts())
    again = fresh_state()
    again.average = WeightAverage(again.model, 0.95)
    again.restore(*load_tensors(path))
    with state.average.in_place(), again.average.in_place():
        assert torch.equal(again.model.weight, state.model.weight)


def test_an_observer_changes_neither_the_bits_nor_the_clock() -> None:
    alone, watched = fresh_state(), fresh_state()
    train(alone, SPEC, step_of(alone), ignore, ignore)
    seen = []

    def look_long(state: TrainingState) -> None:
        seen.append((state.step, state.seconds))
        time.sleep(0.02)

    train(watched, SPEC, step_of(watched), ignore, ignore, look_long)
    assert torch.equal(alone.model.weight, watched.model.weight)
    assert [step for step, _ in seen] == list(range(1, SPEC.steps + 1))
    assert watched.seconds < 0.5 * 0.02 * SPEC.steps


def test_weights_that_cannot_be_written_leave_the_old_ones_and_nothing_else(tmp_path) -> None:
    path = tmp_path / "weights.safetensors"
    save_tensors(path, {"a": torch.ones(3)})
    with pytest.raises(OSError, match=r"weights\.safetensors"):
        # Longer than any file name may be: refused as a full disk would refuse.
        save_tensors(tmp_path / f"{'w' * 250}.weights.safetensors", {"a": torch.zeros(3)})
    assert [one.name for one in tmp_path.iterdir()] == [path.name]
    assert torch.equal(load_tensors(path)[0]["a"], torch.ones(3))
