"""Adam and its schedule at step 0 and on resume, the weights' average, lower precision, divergence."""

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn

from benchmarks.numerics.cases.case import Case, Gradient, Reading, refused
from benchmarks.numerics.cases.long_run import SmallField, wave
from nvsf_core.errors import DivergedError
from nvsf_core.fields.layers import lidar_direction
from nvsf_core.fields.scene_field import SceneField
from nvsf_core.losses.total import LossBreakdown, total_loss
from nvsf_core.recipe import ABLATION, TrainingSpec
from nvsf_core.training.ema import WeightAverage
from nvsf_core.training.loop import TrainingState, make_optimiser, train

TITLE = "Optimiser, averages, divergence"
_RATE = 3e-3
_PAPER = ABLATION[-1]
"""The paper's recipe with everything in it, at the size of `paper_cpu`."""


def _spec(steps: int, **changed: float) -> TrainingSpec:
    return TrainingSpec(steps=steps, rays=32, checkpoint_s=1e9, threads=1, **changed)


def _state(spec: TrainingSpec, seed: int = 0) -> TrainingState:
    generator = torch.Generator().manual_seed(seed)
    field = SmallField(generator)
    return TrainingState(field, make_optimiser(field, spec), generator, average=WeightAverage(field, 0.9))


def _step(state: TrainingState) -> Callable[[int, torch.Generator], list[LossBreakdown]]:
    def step(_: int, draws: torch.Generator) -> list[LossBreakdown]:
        positions = torch.rand(32, 2, generator=draws)
        error = (state.model(positions) - wave(positions)) ** 2
        return [total_loss({"value": error}, {"value": 1.0})]

    return step


def _run(state: TrainingState, spec: TrainingSpec) -> list[dict[str, Tensor]]:
    saved: list[dict[str, Tensor]] = []
    train(state, spec, _step(state), lambda tensors, _: saved.append(tensors), lambda _: None)
    return saved


def _first_step() -> Reading:
    """The very first update for gradients of 1e-18 to 1e18: the rate, times the sign; 0 for none."""
    sizes = np.concatenate([[0.0], np.geomspace(1e-18, 1e18, 73)])
    gradients = torch.from_numpy(np.concatenate([sizes, -sizes])).float()
    model = nn.Linear(1, 1, bias=False)
    model.weight = nn.Parameter(torch.zeros(len(gradients), 1))
    spec = _spec(1, network_rate=_RATE)
    optimiser = make_optimiser(model, spec)
    model.weight.grad = gradients[:, None].clone()
    optimiser.step()
    wide = gradients.double().numpy()
    exact = -_RATE * wide / (np.abs(wide) + 1e-15)
    found = model.weight.detach()[:, 0].double().numpy()
    error = float(np.abs(found - exact).max() / _RATE)
    return Reading(error=error, limit=1e-5, unit="of the rate", float32="ok")


def _too_large() -> Reading:
    """A gradient whose square overflows float32 freezes its weight; saving that is refused."""
    spec = _spec(1)
    state = _state(spec)

    def step(_: int, draws: torch.Generator) -> list[LossBreakdown]:
        scale = torch.tensor(1e25)
        positions = torch.rand(32, 2, generator=draws)
        return [total_loss({"value": (state.model(positions) * scale)}, {"value": 1.0})]

    return refused(DivergedError, lambda: train(state, spec, step, lambda *_: None, lambda _: None))


def _schedule() -> Reading:
    """Rates at step 0, in the middle, at the end, for one step, and after a resume."""
    wrong = []
    for steps in (1, 2, 1250):
        spec = _spec(steps, final_share=0.05)
        seen: list[float] = []
        state = _state(spec)
        train(state, spec, _noting(state, seen), lambda *_: None, lambda _: None)
        exact = [spec.network_rate * math.exp(math.log(0.05) * k / steps) for k in range(steps)]
        wrong.append(max(abs(a - b) / b for a, b in zip(seen, exact, strict=True)))
    return Reading(error=max(wrong), limit=1e-12, unit="relative", outcome="step 0 has the full rate")


def _noting(state: TrainingState, seen: list[float]) -> Callable[[int, torch.Generator], list[LossBreakdown]]:
    """Three steps and then none, with the networks' rate of each written down."""
    inner = _step(state)

    def step(number: int, draws: torch.Generator) -> list[LossBreakdown]:
        seen.append(state.optimiser.param_groups[1]["lr"])
        return inner(number, draws) if number < 3 else []

    return step


def _resumed() -> Reading:
    """Stopped after 60 of 120 steps, restored from tensors, against one that was not: every bit."""
    spec = _spec(120)
    whole, first, second = (_state(spec) for _ in range(3))
    _run(whole, spec)
    facts: dict[str, object] = {}
    tensors: dict[str, Tensor] = {}
    inner = _step(first)

    def stopping(number: int, draws: torch.Generator) -> list[LossBreakdown]:
        if number == 60:
            tensors.update({k: v.clone() for k, v in first.tensors().items()})
            facts.update(first.facts())
        return inner(number, draws)

    train(first, spec, stopping, lambda *_: None, lambda _: None)
    second.restore(tensors, facts)
    _run(second, spec)
    differing = [
        name for name, value in whole.tensors().items() if not torch.equal(value, second.tensors()[name])
    ]
    return Reading(error=float(len(differing)), limit=0.0, unit="tensors differ")


def _average() -> Reading:
    """5,000 updates of a wandering weight against float64; a constant one stays itself exactly."""
    model = nn.Linear(64, 1, bias=False)
    generator = torch.Generator().manual_seed(0)
    nn.init.uniform_(model.weight, -1.0, 1.0, generator=generator)
    still = WeightAverage(model, 0.999)
    still.update()
    constant = bool(torch.equal(still.tensors()["ema.weight"], model.weight))
    average, exact = WeightAverage(model, 0.999), model.weight.detach().double().clone()
    for k in range(1, 5001):
        with torch.no_grad():
            model.weight += 1e-3 * torch.randn(1, 64, generator=generator)
        average.update()
        decay = min(0.999, (1.0 + k) / (10.0 + k))
        exact += (1.0 - decay) * (model.weight.detach().double() - exact)
    found = average.tensors()["ema.weight"].double()
    error = float((found - exact).abs().max() / exact.abs().max())
    return Reading(
        error=error, limit=1e-4, unit="relative", float32="ok", is_refuted=not constant,
        outcome=f"a constant weight's average is itself: {constant}",
    )  # fmt: skip


def _no_average() -> Reading:
    """Decay 0 keeps none; before the first update the weights are their own average; errors undo a swap."""
    model = nn.Linear(2, 1)
    before = model.weight.detach().clone()
    for decay in (0.0, 0.9):
        average = WeightAverage(model, decay)
        try:
            with average.in_place():
                raise ArithmeticError
        except ArithmeticError:
            pass
    same = bool(torch.equal(model.weight, before))
    return Reading(outcome=f"weights as before: {same}", is_refuted=not same)


def _half_precision() -> Reading:
    """The paper's field under bfloat16 autocast: finite, near float32, every gradient finite."""
    field = SceneField(_PAPER, 4, torch.Generator().manual_seed(0))
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(1))
    direction = nn.functional.normalize(
        torch.randn(500, 3, generator=torch.Generator().manual_seed(2)), dim=1
    )

    def rendered() -> tuple[Tensor, Tensor]:
        sigma, geometry = field.density(points, 1.0, "lidar")
        intensity, hit = field.lidar(direction, geometry)
        return sigma, torch.stack([intensity, hit])

    full = [a.detach() for a in rendered()]
    with torch.autocast("cpu", torch.bfloat16):
        half = rendered()
        loss = half[0].float().mean() + half[1].float().mean()
    loss.backward()
    gradients = [p.grad for p in field.parameters() if p.grad is not None]
    finite = all(bool(g.isfinite().all()) for g in gradients)
    errors = [
        float((h.detach().float() - f).abs().max() / f.abs().max()) for h, f in zip(half, full, strict=True)
    ]
    text = f"bf16 density {errors[0]:.1e}, heads {errors[1]:.1e}"
    return Reading(
        gradient=Gradient(finite, 0.0, 0.0), reduced=text if max(errors) < 0.05 else f"fail: {text}",
        outcome="used by no recipe; angles stay in float32" if _angles_are_single() else "angles lost",
    )  # fmt: skip


def _angles_are_single() -> bool:
    with torch.autocast("cpu", torch.bfloat16):
        return lidar_direction(torch.rand(3, 3), _PAPER.heads).dtype is torch.float32


def _injected(where: str) -> Reading:
    """NaN at step 5: an error that names step, term and tensor, and nothing saved."""
    spec = _spec(40)
    state = _state(spec)
    saved: list[int] = []

    def step(number: int, draws: torch.Generator) -> list[LossBreakdown]:
        positions = torch.rand(32, 2, generator=draws)
        target = wave(positions)
        if number == 5 and where == "weights":
            with torch.no_grad():
                state.model.network[0].weight[0, 0] = math.nan  # type: ignore[index, union-attr]
        if number == 5 and where == "batch":
            target[3] = math.nan
        value = state.model(positions)
        if number == 5 and where == "gradient":
            value.register_hook(lambda gradient: gradient * math.nan)
        return [total_loss({"value": (value - target) ** 2}, {"value": 1.0})]

    found = refused(
        DivergedError, lambda: train(state, spec, step, lambda *_: saved.append(state.step), lambda _: None)
    )
    try:
        train(_state(spec), spec, lambda *_: [], lambda *_: None, lambda _: None)
    except DivergedError:
        return Reading(outcome="a clean run is refused", is_refuted=True)
    told = "step" in found.outcome and "'value'" in found.outcome
    return Reading(outcome=found.outcome, is_refuted=found.is_refuted or not told or bool(saved))


CASES = (
    Case("training.loop.make_optimiser", "first step, gradients 0 and 1e-18 to 1e18", _first_step),
    Case("training.loop.train", "gradients of 1e25, beyond float32 squared (outside)", _too_large),
    Case("training.loop.train", "rates of runs of 1, 2 and 1,250 steps", _schedule),
    Case("training.loop.TrainingState", "resumed at step 60 of 120: bit-equal", _resumed),
    Case("training.ema.WeightAverage", "5,000 updates; a constant weight", _average),
    Case("training.ema.WeightAverage", "decay 0, no update yet, an error inside", _no_average),
    Case("fields.scene_field.SceneField", "bfloat16 autocast", _half_precision),
    Case("training.loop.train", "NaN into the weights (outside)", lambda: _injected("weights")),
    Case("training.loop.train", "NaN into the gradients (outside)", lambda: _injected("gradient")),
    Case("training.loop.train", "NaN into a batch (outside)", lambda: _injected("batch")),
)  # fmt: skip
