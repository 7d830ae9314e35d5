"""Sampling of pixels by weights that are zero, huge or NaN; Adam, its schedule and statistics; divergence."""

import gc
import math
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from benchmarks.numerics.cases.case import Case, Reading, largest, refused
from benchmarks.numerics.cases.tolerances import EPS, SUM_EPS
from nvsf_core.errors import DivergedError
from nvsf_core.fields.layers import network
from nvsf_core.kernels.encodings.hash_grid import GridLayout, HashGrid
from nvsf_core.losses.total import LossBreakdown, total_loss
from nvsf_core.recipe.residual import TrainingSpec
from nvsf_core.sampling.error_map import ErrorMap
from nvsf_core.training.loop import Part, TrainingState, make_optimiser, train
from nvsf_core.training.weight_average import WeightAverage

TITLE = "Sampling and training"
_STEPS, _EPOCH, _DECAY = 100_000, 50, 0.999


def _map(fill: float = 1.0, last: float = 1.0) -> ErrorMap:
    """A pano's map of one value, but for its last cell."""
    made = ErrorMap(1, 66, 1030, 2)
    made.errors.fill_(fill)
    made.errors[0, -1, -1] = last
    return made


def _draw(made: ErrorMap, count: int) -> list[tuple[int, int]]:
    rows, columns = made.sample_pixels(0, count, torch.Generator().manual_seed(0))
    return list(zip(rows.tolist(), columns.tolist(), strict=True))


def _one_hot() -> str:
    drawn = sorted(set(_draw(_map(0.0, 1.0), 500)))
    assert set(drawn) <= {(r, c) for r in (64, 65) for c in (1028, 1029)}, f"{drawn}"
    return f"draws of {drawn}"


def _tiny_and_huge() -> str:
    made = _map(1e-30)
    made.errors[0, 0, :10] = 1e30
    drawn = _draw(made, 10)
    assert all(row < 2 and column < 20 for row, column in drawn), f"{drawn}"
    return "ten draws, all from the ten heavy cells"


def _shares(ratio: float) -> float:
    """Half of the cells weigh more by some ratio: their share of 4,000 single draws, less the exact one."""
    made, generator = ErrorMap(1, 8, 8, 2), torch.Generator().manual_seed(0)
    made.errors[0, :2] = ratio
    drawn = [int(made.sample_pixels(0, 1, generator)[0]) < 4 for _ in range(4000)]
    return abs(float(np.mean(drawn)) - ratio / (1.0 + ratio))


def _update(error: Tensor) -> Tensor:
    made, place = _map(), torch.arange(len(error))
    made.update(0, place, place, error)
    return made.errors


def _updates() -> float:
    """Of two pixels in a cell the second has the larger error; their scale does not matter, relative."""
    line, exact = torch.linspace(-1.0, 1.0, 60), 0.1 + 0.9 * (1.0 + 999.0 * np.arange(1, 60, 2) / 59.0)
    assert bool((_update(0.0 * line) == 1.0).all()), "equal errors change the map"
    tiny = _update(1e-45 * line)
    assert bool(((tiny >= 1.0) & (tiny <= 1000.0)).all()), f"{tiny.min()} to {tiny.max()}"
    found = [_update(scale * line)[0].diagonal()[:30] for scale in (1e-30, 1.0, 1e30, 3e38)]
    return max(largest(errors.numpy() / exact, 1.0) for errors in found) / EPS


class _SmallField(nn.Module):
    """A hash grid and a network, as the LiDAR's field has them, over a square."""

    def __init__(self, generator: torch.Generator) -> None:
        super().__init__()
        self.grid = HashGrid(GridLayout(3, 2, 8, 4, 16, dimensions=2), generator)
        self.network = network((self.grid.outputs, 16, 1), generator)

    def forward(self, positions: Tensor) -> Tensor:
        return self.network(self.grid(positions))[:, 0]


def _spec(steps: int) -> TrainingSpec:
    return TrainingSpec(steps=steps, rays=32, final_share=0.1, checkpoint_s=1e9)


def _state(spec: TrainingSpec) -> TrainingState:
    generator = torch.Generator().manual_seed(0)
    field = _SmallField(generator)
    return TrainingState(field, make_optimiser(field, spec), generator, average=WeightAverage(field, _DECAY))


def _loss(state: TrainingState, draws: torch.Generator) -> LossBreakdown:
    """Of 32 places of a wave that the field learns: smooth, between -1 and 1."""
    positions = torch.rand(32, 2, generator=draws)
    wave = torch.sin(6.0 * positions[:, 0]) * torch.cos(4.0 * positions[:, 1])
    return total_loss({"value": (state.model(positions) - wave) ** 2}, {"value": 1.0})


def _first_step() -> float:
    """The rate, times the sign; 0 for none."""
    sizes = np.concatenate([[0.0], np.geomspace(1e-18, 1e18, 73)])
    gradients = torch.from_numpy(np.concatenate([sizes, -sizes])).float()
    model, spec = nn.Linear(1, 1, bias=False), _spec(1)
    model.weight = nn.Parameter(torch.zeros(len(gradients), 1))
    optimiser = make_optimiser(model, spec)
    model.weight.grad = gradients[:, None].clone()
    optimiser.step()
    exact = -gradients.double() / (gradients.double().abs() + 1e-15)
    return largest(model.weight.detach()[:, 0] / spec.network_rate, exact)


def _too_large() -> None:
    """Its square freezes the weight in float32; saving that is refused."""
    state = _state(_spec(1))

    def step(_: int, draws: torch.Generator) -> list[Part]:
        places = torch.rand(32, 2, generator=draws)
        return [lambda: [total_loss({"value": state.model(places) * 1e25}, {"value": 1.0})]]

    train(state, _spec(1), step, lambda *_: None, lambda _: None)


def _injected(inject: Callable[[_SmallField], object]) -> str:
    """NaN at step 5: an error that names step and term, and nothing saved."""
    state, saved = _state(_spec(40)), []

    def step(number: int, draws: torch.Generator) -> list[Part]:
        if number == 5:
            inject(state.model)
        return [lambda: [_loss(state, draws)]]

    said = refused(DivergedError, lambda: train(state, _spec(40), step, lambda *_: saved.append(1), print))()
    assert "step 5" in said and "'value'" in said and not saved, said
    return said


def _break_a_weight(field: _SmallField) -> None:
    with torch.no_grad():
        field.network[0].weight[0, 0] = math.nan


def _resident_kb() -> int:
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") // 1024


def long_run(steps: int) -> Reading:
    """Train the small field by the project's own loop: no drift, no growth, the weights' average exact."""
    spec, losses, memory_kb = _spec(steps), torch.zeros(steps), []
    state = _state(spec)
    weight = state.model.network[2].weight
    exact = weight.detach().double().clone()

    def step(number: int, draws: torch.Generator) -> list[Part]:
        epoch, within = divmod(number, _EPOCH)
        if epoch and not within:
            state.average.update()
            decay = min(_DECAY, (1.0 + epoch) / (10.0 + epoch))
            exact.add_((1.0 - decay) * (weight.detach().double() - exact))
        if number == steps // 10:
            memory_kb.append(_resident_kb())
        losses[number] = (loss := _loss(state, draws)).terms["value"]
        return [lambda: [loss]]

    train(state, spec, step, lambda *_: None, lambda _: None)
    growth, tensors = _resident_kb() / memory_kb[0] - 1.0, state.tensors()
    middle, last = (losses.chunk(10)[tenth].mean().item() for tenth in (4, 9))
    assert all(bool(t.isfinite().all()) for t in tensors.values() if t.is_floating_point()), "not finite"
    assert last <= middle, f"the loss drifts from {middle:.2e} in the fifth tenth to {last:.2e} in the last"
    assert growth < 0.01, f"memory grows by {growth:.2%}"
    error = largest(tensors["ema.network.2.weight"], exact) / exact.abs().max().item()
    said = f"loss {middle:.2e} in the fifth tenth, {last:.2e} in the last; memory {growth:+.2%}"
    return Reading(error=error, outcome=said)


_DRAW = "sampling.error_map.ErrorMap.sample_pixels"
_UPDATE, _TRAIN = "sampling.error_map.ErrorMap.update", "training.loop.train"
CASES = (
    Case(_DRAW, "one-hot weights, 500 draws of one cell", _one_hot),
    Case(_DRAW, "weights 1e-30 and 1e30", _tiny_and_huge),
    # The limits are four standard deviations.
    Case(_DRAW, "equal weights, 4,000 single draws", lambda: _shares(1.0), 0.032, "share"),
    Case(_DRAW, "weights 1 and 1000, 4,000 single draws", lambda: _shares(1000.0), 0.002, "share"),
    Case(_DRAW, "all-zero weights (outside)", refused(DivergedError, lambda: _draw(_map(0.0, 0.0), 10))),
    Case(_DRAW, "an infinite weight (outside)", refused(DivergedError, lambda: _draw(_map(1, math.inf), 10))),
    Case(_DRAW, "a NaN weight (outside)", refused(DivergedError, lambda: _draw(_map(1, math.nan), 10))),
    Case(_UPDATE, "errors ±1e-45 to ±3e38, and all equal", _updates, SUM_EPS, "eps"),
    Case(_UPDATE, "a NaN error (outside)", refused(DivergedError, lambda: _update(torch.tensor([math.nan])))),
    Case("training.loop.make_optimiser", "first step, gradients 0 and 1e-18 to 1e18", _first_step, 1e-5),
    Case(_TRAIN, "gradients of 1e25, beyond float32 squared (outside)", refused(DivergedError, _too_large)),
    Case(_TRAIN, "NaN into the weights (outside)", lambda: _injected(_break_a_weight)),
    Case(_TRAIN, "NaN into the gradients (outside)",
         lambda: _injected(lambda field: field.grid.table.register_hook(lambda slope: slope * math.nan))),
    Case(_TRAIN, "NaN into a batch (outside)",
         lambda: _injected(lambda field: field.register_forward_pre_hook(lambda _, x: (x[0] * math.nan,)))),
    Case(_TRAIN, f"{_STEPS:,} steps of a small field, EMA every {_EPOCH}", lambda: long_run(_STEPS), 1e-5),
)  # fmt: skip
