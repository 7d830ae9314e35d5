"""Expected and median range with partial opacity; losses of ranges at their limits."""

import math
from itertools import accumulate

import numpy as np
import torch

from benchmarks.numerics.cases.case import Case, Gradient, Reading, refused
from benchmarks.numerics.cases.references import HALVES, against, by_autograd
from benchmarks.numerics.cases.tolerances import TOLERANCES
from nvsf_core.errors import DivergedError
from nvsf_core.losses.lidar import depth_loss
from nvsf_core.losses.line_of_sight import line_of_sight_loss
from nvsf_core.losses.total import total_loss
from nvsf_core.rendering.weights import (
    expected_value,
    value_at,
    weighted_median_index,
    weights_from_optical_depth,
)

TITLE = "Expected and median range"


def _rays(seed: int, total: float) -> tuple[np.ndarray, np.ndarray]:
    """Weights (200, 768) that sum to about `total`, and ranges in metres."""
    rng = np.random.default_rng(seed)
    weights = rng.random((200, 768)) ** 8
    weights *= total / weights.sum(axis=1, keepdims=True)
    return weights, np.sort(rng.uniform(1.0, 80.0, (200, 768)), axis=1)


def _expected(total: float) -> Reading:
    weights, ranges = _rays(0, total)
    return against(
        expected_value, by_autograd(lambda w, v: (w * v).sum(dim=1)), [weights, ranges], is_sum=True,
        outcome="not divided by the weights' sum: the hit probability is a number of its own",
    )  # fmt: skip


def _median(total: float) -> Reading:
    """Against a loop that adds up exactly; what differs may be one sample's weight of rounding."""
    weights, ranges = _rays(1, total)
    worst = 0.0
    types = (torch.float32, *HALVES) if total == 1.0 else (torch.float32,)
    notes: list[float] = []
    for dtype in types:
        tensor = torch.from_numpy(weights).to(dtype)
        index = weighted_median_index(tensor).numpy()
        slack = 0.0
        for ray, chosen in enumerate(index):
            exact = tensor[ray].double().tolist()
            sums = list(accumulate(exact))
            half = 0.5 * math.fsum(exact)
            # How far from the middle the chosen sample's own stretch of weight lies.
            before = sums[chosen - 1] if chosen else 0.0
            slack = max(slack, (max(half - sums[chosen], before - half, 0.0)) / (2.0 * half))
        notes.append(slack)
        if dtype is torch.float32:
            worst = slack / torch.finfo(dtype).eps
            positions = value_at(torch.from_numpy(ranges), torch.from_numpy(index))
            assert bool(torch.isfinite(positions).all())
    halves = [
        f"{name} {slack:.1e} of the weight" for name, slack in zip(("bf16", "fp16"), notes[1:], strict=False)
    ]
    failing = any(slack > 1e-4 for slack in notes[1:])
    return Reading(
        error=worst, limit=TOLERANCES[torch.float32].sum_eps, unit="eps of the weight", float32="ok",
        reduced=("fail: " if failing else "") + "; ".join(halves) or "n/a: fp16 rounds them to 0",
    )  # fmt: skip


def _bimodal() -> Reading:
    """Two surfaces of nearly equal weight: the median lies on one of them, never between."""
    share = np.linspace(0.4, 0.6, 2001)
    weights = torch.zeros(len(share), 768)
    weights[:, 100], weights[:, 700] = torch.from_numpy(share).float(), torch.from_numpy(1 - share).float()
    index = weighted_median_index(weights)
    on_surface = bool(((index == 100) | (index == 700)).all())
    return Reading(outcome=f"always on a surface: {on_surface}", float32="ok", is_refuted=not on_surface)


def _no_weight() -> Reading:
    weights, after = weights_from_optical_depth(torch.zeros(5, 768))
    index = weighted_median_index(weights)
    stated = bool((index == 0).all()) and bool((after == 1.0).all())
    return Reading(
        outcome="index 0, as stated, with a total weight of 0", float32="ok", is_refuted=not stated
    )


def _sight(epsilon: float) -> Reading:
    rng = np.random.default_rng(2)
    t = np.sort(rng.uniform(0.0, 1.5, (100, 96)), axis=1)
    weights = rng.dirichlet(np.ones(96), 100)
    true = rng.uniform(0.1, 1.4, 100)
    true[:10] = 0.0
    true[10:20] = 0.5 * (t[10:20, 40] + t[10:20, 41])
    arrays = [torch.from_numpy(a).float().requires_grad_() for a in (weights, t)]
    loss = line_of_sight_loss(arrays[0], arrays[1], torch.from_numpy(true).float(), epsilon)
    loss.sum().backward()
    grads = [a.grad for a in arrays if a.grad is not None]
    finite = all(bool(torch.isfinite(x).all()) for x in (loss.detach(), *grads))
    bounded = float(loss.detach().max()) <= 2.0 + 1e-5
    return Reading(
        gradient=Gradient(finite, 0.0, 0.0), float32="ok", is_refuted=not bounded,
        outcome=f"loss from {float(loss.detach().min()):.2g} to {float(loss.detach().max()):.2g}, at most 2",
    )  # fmt: skip


def _depth_loss() -> Reading:
    """No weight, all weight, errors of 0 and beyond the clamp."""
    weights = np.array([[0.0, 0.0], [1.0, 0.0], [0.5, 0.5], [0.3, 0.3]])
    ranges = np.array([[10.0, 20.0], [10.0, 20.0], [10.5, 19.0], [12.0, 1e6]])

    def plain(w: torch.Tensor, r: torch.Tensor) -> torch.Tensor:
        return (w * (r - 10.25).abs().clamp(max=3.0)).sum(1) + 3.0 * (1.0 - w.sum(1))

    return against(
        lambda w, r: depth_loss(w, r, torch.full((4,), 10.25, dtype=w.dtype)), by_autograd(plain),
        [weights, ranges], scale=3.0, halves=(),
    )  # fmt: skip


def _nan_term() -> Reading:
    terms = {"depth": torch.tensor([1.0, math.nan]), "hit": torch.ones(3)}
    found = refused(DivergedError, lambda: total_loss(terms, {"depth": 1.0, "hit": 1.0}))
    return Reading(outcome=found.outcome, is_refuted=found.is_refuted or "'depth'" not in found.outcome)


_MEDIAN = "rendering.accumulate.weighted_median_index"
CASES = (
    Case("rendering.accumulate.expected_value", "768 samples, weights sum to 1", lambda: _expected(1.0)),
    Case("rendering.accumulate.expected_value", "weights sum to 1e-6: thin air", lambda: _expected(1e-6)),
    Case(_MEDIAN, "768 samples, weights sum to 1", lambda: _median(1.0)),
    Case(_MEDIAN, "weights sum to 1e-6", lambda: _median(1e-6)),
    Case(_MEDIAN, "two surfaces, shares 0.4 to 0.6", _bimodal),
    Case(_MEDIAN, "no weight at all", _no_weight),
    Case(
        _MEDIAN, "NaN (outside)",
        lambda: refused(DivergedError, lambda: weighted_median_index(torch.tensor([[0.1, math.nan]]))),
    ),
    Case(
        _MEDIAN, "negative weight (outside)",
        lambda: refused(DivergedError, lambda: weighted_median_index(torch.tensor([[0.1, -0.2]]))),
    ),
    Case("losses.depth.depth_loss", "weights sum to 0 .. 1, errors 0 to 1e6 m", _depth_loss),
    Case("losses.line_of_sight.line_of_sight_loss", "half width 0.02", lambda: _sight(0.02)),
    Case("losses.line_of_sight.line_of_sight_loss", "half width 1e-12", lambda: _sight(1e-12)),
    Case("losses.line_of_sight.line_of_sight_loss", "half width 1e-300", lambda: _sight(1e-300)),
    Case("losses.total.total_loss", "a term is NaN (outside)", _nan_term),
)  # fmt: skip
