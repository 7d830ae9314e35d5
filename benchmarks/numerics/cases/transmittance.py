"""Transmittance: thin, thick, opaque and empty samples, and many of them."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from benchmarks.numerics.cases.case import Case, Gradient, Reading, refused
from benchmarks.numerics.cases.references import HALVES, against, by_autograd
from benchmarks.numerics.cases.tolerances import TOLERANCES
from nvsf_core.errors import DataError, DivergedError
from nvsf_core.rendering.weights import weights_from_opacity_logits, weights_from_optical_depth
from nvsf_core.sampling.along_ray import uniform_samples

TITLE = "Transmittance and samples along a ray"


def _weights(depth: Tensor) -> Tensor:
    weights, after = weights_from_optical_depth(depth)
    return torch.cat([weights, after[:, None]], dim=1)


def _plain(depth: Tensor) -> Tensor:
    """The product formula, with the difference of two transmittances for a weight."""
    passed = torch.exp(-torch.cumsum(torch.nn.functional.pad(depth, (1, 0)), dim=1))
    thin = passed[:, :-1] * torch.where(depth < 1e-4, depth - depth**2 / 2, 1 - torch.exp(-depth))
    return torch.cat([thin, passed[:, -1:]], dim=1)


def _one_sample(low: float, high: float) -> Reading:
    depths = np.concatenate([[0.0], np.geomspace(low, high, 400)])[:, None]
    return against(
        lambda tau: weights_from_optical_depth(tau)[0],
        by_autograd(lambda tau: torch.where(tau < 1e-5, tau - tau**2 / 2, 1 - torch.exp(-tau))),
        [depths],
        # torch's slope of expm1 is its value plus 1, right to within the last place of 1.
        gradient_scale=1.0,
    )


def _mixed() -> Reading:
    """Rays whose samples differ by sixteen orders of magnitude, against float64."""
    rng = np.random.default_rng(0)
    depths = 10.0 ** rng.uniform(-8.0, 8.0, (64, 96))
    depths[rng.random(depths.shape) < 0.7] *= 1e-8
    return against(_weights, by_autograd(_plain), [depths], scale=1.0, is_sum=True, has_gradient=False)


def _mixed_gradient() -> Reading:
    rng = np.random.default_rng(1)
    depths = torch.from_numpy(10.0 ** rng.uniform(-8.0, 8.0, (64, 96))).float()
    colours = torch.from_numpy(rng.random((64, 97))).float()
    found = _slope(_weights, depths, colours)
    exact = _slope(_plain, depths.double(), colours.double())
    error = float((found.double() - exact).abs().max() / exact.abs().max())
    gradient = Gradient(bool(torch.isfinite(found).all()), error, TOLERANCES[torch.float32].gradient)
    return Reading(gradient=gradient, float32="ok")


def _slope(function, depths: Tensor, colours: Tensor) -> Tensor:  # type: ignore[no-untyped-def]
    x = depths.clone().requires_grad_()
    (function(x) * colours).sum().backward()
    assert x.grad is not None
    return x.grad


def _tiny_factors() -> Reading:
    """768 factors of 1 - 1e-8: a product in float32 would leave exactly 1."""
    depths = np.full((4, 768), 1e-8) * np.array([[1.0], [10.0], [1e3], [1e5]])
    colour = torch.linspace(-1.0, 1.0, 769)  # without it all add up to the constant 1
    reading = against(
        lambda tau: _weights(tau) * colour.to(tau.dtype),
        by_autograd(lambda tau: _plain(tau) * colour.double()), [depths], halves=(), gradient_scale=1.0,
    )  # fmt: skip
    lost = float(torch.cumprod(1.0 - torch.full((768,), 1e-8), 0)[-1])
    return Reading(
        error=reading.error, limit=TOLERANCES[torch.float32].sum_eps, unit="ulp", gradient=reading.gradient,
        float32="ok", cuda=reading.cuda, reduced="n/a: fp16 rounds 1e-8 to 0",
        outcome=f"a product of 1 - τ leaves {lost}, the sum {math.exp(-768e-8):.7f}",
    )  # fmt: skip


def _opaque() -> Reading:
    inf = math.inf
    depths = torch.tensor([[0.0, inf, 3.0], [inf, inf, inf], [1e38, 1e38, 1e38], [0.0, 0.0, 0.0]])
    expected = torch.tensor([[0.0, 1, 0, 0], [1, 0, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    depths.requires_grad_()
    weights = _weights(depths)
    error = float((weights.detach() - expected).abs().max())
    weights.square().sum().backward()
    assert depths.grad is not None
    slope = Gradient(bool(torch.isfinite(depths.grad).all()), 0.0, 0.0)
    return Reading(error=error, limit=0.0, unit="", gradient=slope, float32="ok")


def _logits() -> Reading:
    rng = np.random.default_rng(2)
    logits = rng.uniform(-20.0, 20.0, (64, 24)) * rng.choice([1.0, 0.2, 5.0], (64, 1))

    def plain(x: Tensor) -> Tensor:
        passed = torch.cumprod(torch.nn.functional.pad(torch.sigmoid(-x), (1, 0), value=1.0), dim=1)
        return passed[:, :-1] * torch.sigmoid(x)

    return against(
        lambda x: weights_from_opacity_logits(x)[0], by_autograd(plain), [logits],
        scale=1.0, is_sum=True, has_gradient=False,
    )  # fmt: skip


def _logits_extreme() -> Reading:
    logits = torch.tensor([[-math.inf, -1e30, -100.0, 0.0, 100.0, 1e30, 3.0, -math.inf]]).requires_grad_()
    weights, after = weights_from_opacity_logits(logits)
    (weights.square().sum() + after.sum()).backward()
    assert logits.grad is not None
    wrong = (weights.detach() - torch.tensor([[0, 0, 0, 0.5, 0.5, 0, 0, 0]])).abs().max()
    slope = Gradient(bool(torch.isfinite(logits.grad).all()), 0.0, 0.0)
    return Reading(error=float(wrong), limit=1e-6, gradient=slope, float32="ok")


def _zero_length() -> Reading:
    """Zero-length and repeated intervals weigh exactly nothing, and do not disturb their neighbours."""
    rng = np.random.default_rng(3)
    sigma = torch.from_numpy(10.0 ** rng.uniform(-3, 17, (200, 32))).float()
    length = torch.from_numpy(rng.random((200, 32))).float()
    empty = torch.from_numpy(rng.random((200, 32)) < 0.5)
    weights, after = weights_from_optical_depth(sigma * length.masked_fill(empty, 0.0))
    zero = bool((weights[empty] == 0.0).all())
    error = 0.0
    for ray in range(200):
        kept = ~empty[ray]
        alone, passed = weights_from_optical_depth((sigma[ray, kept] * length[ray, kept])[None])
        both = torch.cat([weights[ray, kept] - alone[0], after[ray] - passed])
        error = max(error, float(both.abs().max()))
    return Reading(
        error=error, limit=1e-6, outcome=f"weight of a zero-length interval exactly 0: {zero}",
        float32="ok", is_refuted=not zero,
    )  # fmt: skip


def _sums() -> Reading:
    rng = np.random.default_rng(4)
    worst: list[float] = []
    for dtype in (torch.float32, *HALVES):
        depths = torch.from_numpy(10.0 ** rng.uniform(-8.0, 4.0, (256, 768))).to(dtype)
        weights, after = weights_from_optical_depth(depths)
        total = weights.double().sum(dim=1) + after.double()
        worst.append(float((total - 1.0).abs().max()) / torch.finfo(dtype).eps)
    limit = TOLERANCES[torch.float32].sum_eps
    return Reading(
        error=worst[0], limit=limit, unit="eps", float32="ok",
        reduced=f"bf16 {worst[1]:.2g} eps; fp16 {worst[2]:.2g} eps",
    )  # fmt: skip


def _samples() -> Reading:
    """Ascending, inside, lengths not negative: from intervals of length 0 to 1e8, jittered."""
    rng = np.random.default_rng(5)
    near = torch.from_numpy(10.0 ** rng.uniform(-8, 3, 400)).float()
    length = 10.0 ** rng.uniform(-8, 8, 400) * (rng.random(400) > 0.1)
    far = torch.maximum(near + torch.from_numpy(length).float(), near)
    broken = []
    for generator in (None, torch.Generator().manual_seed(0)):
        t, delta = uniform_samples(near, far, 768, generator)
        named_checks: Sequence[Tensor] = (
            torch.isfinite(t), t >= near[:, None], t <= far[:, None], t.diff(dim=1) >= 0, delta >= 0,
        )  # fmt: skip
        broken += [k for k, law in enumerate(named_checks) if not bool(law.all())]
    exact = near.double()[:, None] + (far - near).double()[:, None] * torch.linspace(0, 1, 768).double()
    t, _ = uniform_samples(near, far, 768)
    scale = torch.maximum(far, near).double()[:, None] * torch.finfo(torch.float32).eps
    error = float(((t.double() - exact).abs() / scale).max())
    return Reading(
        error=error, limit=TOLERANCES[torch.float32].elementwise_ulp, unit="eps of far", float32="ok",
        outcome=f"laws broken: {broken}", is_refuted=bool(broken),
    )  # fmt: skip


def _refused_samples(near: float, far: float) -> Reading:
    return refused(DataError, lambda: uniform_samples(torch.tensor([near]), torch.tensor([far]), 8))


_WEIGHTS = "rendering.weights.weights_from_optical_depth"
_SAMPLES = "sampling.along_ray.uniform_samples"
CASES = (
    Case(_WEIGHTS, "one sample, τ = 0 and 1e-8 to 1", lambda: _one_sample(1e-8, 1.0)),
    Case(_WEIGHTS, "one sample, τ = 1 to 80", lambda: _one_sample(1.0, 80.0)),
    Case(_WEIGHTS, "96 samples, τ 1e-16 to 1e8 on one ray", _mixed),
    Case(_WEIGHTS, "the same, gradient of a random colour", _mixed_gradient),
    Case(_WEIGHTS, "768 factors, τ 1e-8 to 1e-3", _tiny_factors),
    Case(_WEIGHTS, "opaque walls: τ = inf, 1e38, sums beyond float32", _opaque),
    Case(_WEIGHTS, "zero-length and repeated intervals, σ up to 1e17", _zero_length),
    Case(_WEIGHTS, "768 samples, τ 1e-8 to 1e4: weights and rest sum to 1", _sums),
    Case("rendering.weights.weights_from_opacity_logits", "24 surfaces, logits ±100", _logits),
    Case("rendering.weights.weights_from_opacity_logits", "logits ±1e30, -inf", _logits_extreme),
    Case(_SAMPLES, "near 1e-8 to 1e3, length 0 to 1e8, 768 samples, with and without jitter", _samples),
    Case(_SAMPLES, "far = inf (outside)", lambda: _refused_samples(1.0, math.inf)),
    Case(_SAMPLES, "NaN (outside)", lambda: _refused_samples(math.nan, 1.0)),
    Case(_SAMPLES, "far < near (outside)", lambda: _refused_samples(2.0, 1.0)),
    Case(
        _WEIGHTS, "τ = -1 (outside)",
        lambda: refused(DivergedError, lambda: weights_from_optical_depth(torch.tensor([[-1.0]]))),
    ),
)  # fmt: skip
