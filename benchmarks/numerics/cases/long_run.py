"""A hundred thousand steps of a small field: no drift, no growth, statistics still exact."""

import gc
import os
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from benchmarks.numerics.cases.case import Case, Reading
from nvsf_core.encodings import HashGrid
from nvsf_core.fields.layers import network
from nvsf_core.kernels import GridLayout
from nvsf_core.losses.total import LossBreakdown, total_loss
from nvsf_core.recipe import TrainingSpec
from nvsf_core.training.ema import WeightAverage
from nvsf_core.training.loop import TrainingState, make_optimiser, train

TITLE = "Long runs"
STEPS = 100_000
_POINTS = 32
_EPOCH = 50
_DECAY = 0.999
_BETAS = (0.9, 0.99)


class SmallField(nn.Module):
    """A hash grid and a network, as the LiDAR's field has them, over a square."""

    def __init__(self, generator: torch.Generator) -> None:
        super().__init__()
        self.grid = HashGrid(GridLayout(3, 2, 8, 4, 16, dimensions=2), generator)
        self.network = network((self.grid.outputs, 16, 1), generator)

    def forward(self, positions: Tensor) -> Tensor:
        """Values (n,) at positions (n, 2) of the unit square."""
        found: Tensor = self.network(self.grid(positions))[:, 0]
        return found


def wave(positions: Tensor) -> Tensor:
    """What the field learns: smooth, between -1 and 1."""
    return torch.sin(6.0 * positions[:, 0]) * torch.cos(4.0 * positions[:, 1])


class Shadow:
    """Adam's and the average's running statistics of one weight tensor, kept in float64 beside the run."""

    def __init__(self, parameter: nn.Parameter) -> None:
        self.parameter = parameter
        self.first = torch.zeros_like(parameter, dtype=torch.float64)
        self.second = torch.zeros_like(parameter, dtype=torch.float64)
        self.average = parameter.detach().double().clone()
        self.updates = 0
        parameter.register_hook(self._take)

    def _take(self, gradient: Tensor) -> None:
        wide = gradient.double()
        self.first = _BETAS[0] * self.first + (1.0 - _BETAS[0]) * wide
        self.second = _BETAS[1] * self.second + (1.0 - _BETAS[1]) * wide**2

    def epoch(self) -> None:
        """As `WeightAverage.update`."""
        self.updates += 1
        decay = min(_DECAY, (1.0 + self.updates) / (10.0 + self.updates))
        self.average += (1.0 - decay) * (self.parameter.detach().double() - self.average)


@dataclass(frozen=True, slots=True)
class LongRun:
    """What a long run showed; errors are relative to the largest entry."""

    middle_loss: float
    """Mean over the fifth tenth of the steps."""
    last_loss: float
    """Mean over the last tenth."""
    growth: float
    """Of resident memory from the first tenth to the end, as a share."""
    first_moment: float
    """Error of Adam's first moment after all steps."""
    second_moment: float
    """Error of its second moment."""
    average: float
    """Error of the weights' average."""
    is_finite: bool
    """Of all weights and statistics."""


def long_run(steps: int, seed: int = 0) -> LongRun:
    """Train the small field for so many steps of the project's own loop."""
    generator = torch.Generator().manual_seed(seed)
    field = SmallField(generator)
    spec = TrainingSpec(steps=steps, rays=_POINTS, final_share=0.1, checkpoint_s=1e9, threads=1)
    state = TrainingState(field, make_optimiser(field, spec), generator)
    state.average = WeightAverage(field, _DECAY)
    shadow = Shadow(field.network[2].weight)  # type: ignore[arg-type]
    losses = torch.zeros(steps)
    memory_kb: list[int] = []

    def step(number: int, draws: torch.Generator) -> list[LossBreakdown]:
        if number and number % _EPOCH == 0:
            state.average.update()  # type: ignore[union-attr]
            shadow.epoch()
        if number == steps // 10:
            memory_kb.append(_resident_kb())
        positions = torch.rand(_POINTS, 2, generator=draws)
        loss = total_loss({"value": (field(positions) - wave(positions)) ** 2}, {"value": 1.0})
        losses[number] = loss.terms["value"]
        return [loss]

    train(state, spec, step, lambda _tensors, _facts: None, lambda _line: None)
    memory_kb.append(_resident_kb())
    moments = state.optimiser.state[shadow.parameter]
    tensors = state.tensors()
    tenth = max(steps // 10, 1)
    return LongRun(
        middle_loss=float(losses[4 * tenth : 5 * tenth].mean()),
        last_loss=float(losses[-tenth:].mean()),
        growth=memory_kb[1] / memory_kb[0] - 1.0,
        first_moment=_relative(moments["exp_avg"], shadow.first),
        second_moment=_relative(moments["exp_avg_sq"], shadow.second),
        average=_relative(tensors["ema.network.2.weight"], shadow.average),
        is_finite=all(bool(t.isfinite().all()) for t in tensors.values() if t.is_floating_point()),
    )


def _relative(found: Tensor, exact: Tensor) -> float:
    return float((found.double() - exact).abs().max() / exact.abs().max())


def _resident_kb() -> int:
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") // 1024


def _case() -> Reading:
    found = long_run(STEPS)
    broken = [
        name
        for name, sound in (
            ("finite", found.is_finite), ("no drift", found.last_loss <= found.middle_loss),
            ("memory", found.growth < 0.01), ("first moment", found.first_moment < 1e-5),
            ("second moment", found.second_moment < 1e-5), ("average", found.average < 1e-4),
        )
        if not sound
    ]  # fmt: skip
    outcome = (
        f"loss {found.middle_loss:.2e} in the fifth tenth, {found.last_loss:.2e} in the last; memory "
        f"{found.growth:+.2%}; Adam's moments off by {found.first_moment:.1e} and {found.second_moment:.1e}, "
        f"the average by {found.average:.1e}; broken: {broken or 'none'}"
    )
    worst = max(found.first_moment, found.second_moment, found.average)
    return Reading(
        error=worst, limit=1e-4, unit="relative", float32="ok", outcome=outcome, is_refuted=bool(broken)
    )


CASES = (Case("training.loop.train", f"{STEPS:,} steps of a small field, EMA every {_EPOCH}", _case),)
