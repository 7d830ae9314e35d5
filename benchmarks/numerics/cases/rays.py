"""Densities, samples, weights and ranges of rays through thin, thick, opaque and empty media."""

import math
from functools import partial

import mpmath
import numpy as np
import torch
from torch import Tensor

from benchmarks.numerics.cases.case import Case, Reading, finite_gradient, largest, refused
from benchmarks.numerics.cases.references import against, by_autograd, by_mpmath, every_float
from benchmarks.numerics.cases.tolerances import ELEMENTWISE_ULP, EPS, SUM_EPS
from nvsf_core import numerics
from nvsf_core.errors import DataError, DivergedError
from nvsf_core.evidence.surfels import weighted_median_index
from nvsf_core.fields.layers import Density
from nvsf_core.kernels.composite import composite_rays
from nvsf_core.losses.lidar import CLAMP_M, depth_loss
from nvsf_core.recipe.paper import HeadsSpec
from nvsf_core.rendering.scaled_rays import ScaledRays
from nvsf_core.rendering.volume import render_volume, uniform_samples, weights_from_optical_depth

TITLE = "Density, transmittance and ranges along a ray"
_NAN = torch.tensor(math.nan)
_logit = partial(numerics.probability_logit, margin=0.003)
"""With the smallest margin that a hit probability is clamped by."""


def _safe_exp() -> Reading:
    saturation, steepest = numerics.EXP_SATURATION, numerics.EXP_GRADIENT_LIMIT
    exact = by_mpmath(
        lambda x: mpmath.exp(min(x, saturation)), lambda x: mpmath.exp(max(min(x, steepest), -steepest))
    )
    assert numerics.safe_exp(_NAN).isnan()
    return against(numerics.safe_exp, exact, [np.append(every_float(600), np.linspace(-110.0, 60.0, 1701))])


def _probability_logit() -> Reading:
    low, high = mpmath.mpf(np.float32(0.003).item()), mpmath.mpf(np.float32(0.997).item())

    def value(p: mpmath.mpf) -> mpmath.mpf:
        p = min(max(p, low), high)
        return mpmath.log(p / (1 - p))

    def slope(p: mpmath.mpf) -> mpmath.mpf:
        return 1 / (p * (1 - p)) if low <= p <= high else mpmath.mpf(0)

    numbers = np.concatenate([every_float(300), np.linspace(0.002, 0.45, 300), np.linspace(0.55, 0.998, 300)])
    assert _logit(_NAN).isnan()
    # Its largest value is 5.8: errors count at the last place of that.
    return against(_logit, by_mpmath(value, slope), [numbers], scale=5.8)


def _density() -> Reading:
    network = Density(8, HeadsSpec(), torch.Generator().manual_seed(0))
    features = torch.linspace(-1e4, 1e4, 400)[:, None].expand(-1, 8).clone().requires_grad_()
    sigma, geometry = network(features)
    gradient = finite_gradient(sigma.clamp_max(1e3).sum() + geometry.sum(), features, *network.parameters())
    low, high = sigma.min().item(), sigma.max().item()
    assert high <= math.exp(40.0) * 1.001, "σ beyond e^40"
    return Reading(gradient=gradient, outcome=f"σ from {low:.1e} to {high:.1e}")


def _weights(depth: Tensor) -> Tensor:
    weights, after = weights_from_optical_depth(depth)
    return torch.cat([weights, after[:, None]], dim=1)


def _plain_weights(depth: Tensor) -> Tensor:
    """The product formula, with the difference of two transmittances for a weight."""
    passed = torch.exp(-torch.cumsum(torch.nn.functional.pad(depth, (1, 0)), dim=1))
    thin = passed[:, :-1] * torch.where(depth < 1e-4, depth - depth**2 / 2, 1 - torch.exp(-depth))
    return torch.cat([thin, passed[:, -1:]], dim=1)


def _one_sample() -> Reading:
    depths = np.concatenate([[0.0], np.geomspace(1e-8, 80.0, 800)])[:, None]
    exact = by_mpmath(lambda tau: -mpmath.expm1(-tau), lambda tau: mpmath.exp(-tau))
    # torch's slope of expm1 is its value plus 1, right to within the last place of 1.
    return against(lambda tau: weights_from_optical_depth(tau)[0], exact, [depths], gradient_scale=1.0)


def _coloured(depths: np.ndarray, colour: Tensor, scale: float | None) -> Reading:
    """Weights times a colour: without it they add up to the constant 1, which has no gradient."""
    exact = by_autograd(lambda tau: _plain_weights(tau) * colour.double())
    return against(
        lambda tau: _weights(tau) * colour.to(tau), exact, [depths], scale=scale, gradient_scale=1.0
    )


def _mixed() -> Reading:
    rng = np.random.default_rng(0)
    depths = 10.0 ** rng.uniform(-8.0, 8.0, (64, 96))
    depths[rng.random(depths.shape) < 0.7] *= 1e-8
    return _coloured(depths, torch.from_numpy(rng.random((64, 97))), 1.0)


def _thin() -> Reading:
    depths = np.full((4, 768), 1e-8) * [[1.0], [10.0], [1e3], [1e5]]
    return _coloured(depths, torch.linspace(-1.0, 1.0, 769), None)


def _opaque() -> Reading:
    inf = math.inf
    depths = torch.tensor([[0.0, inf, 3.0], [inf, inf, inf], [1e38, 1e38, 1e38], [0.0, 0.0, 0.0]])
    weights = _weights(depths.requires_grad_())
    expected = torch.tensor([[0.0, 1, 0, 0], [1, 0, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    slope = finite_gradient(weights.square().sum(), depths)
    return Reading(error=largest(weights.detach(), expected), gradient=slope)


def _sums() -> float:
    """Rays from thin to opaque: all weights and the transmittance behind them, in machine epsilons."""
    thickest = np.linspace(-7.0, 4.0, 256)[:, None]
    depths = torch.from_numpy(10.0 ** np.random.default_rng(4).uniform(-8.0, thickest, (256, 768))).float()
    return largest(_weights(depths).double().sum(dim=1), 1.0) / EPS


def _zero_length() -> float:
    """They weigh exactly nothing, and do not disturb their neighbours."""
    rng = np.random.default_rng(3)
    depth = torch.from_numpy(10.0 ** rng.uniform(-3, 17, (200, 32)) * rng.random((200, 32))).float()
    weights = _weights(torch.stack([depth, torch.zeros_like(depth)], dim=2).flatten(1))
    assert not weights[:, 1::2].any(), "a zero-length interval has a weight"
    return largest(weights[:, ::2], _weights(depth))


def _composited(logit: Tensor) -> Tensor:
    """Weights (rays, surfaces) by the kernel that our own fields' LiDAR rays are rendered with."""
    n = logit.numel()
    weights, *_ = composite_rays(
        logit.reshape(-1), torch.ones(n), torch.zeros(n, 1), torch.zeros(n, 6),
        torch.arange(0, n + 1, logit.shape[1]), torch.full((n,), -1.0), torch.ones(len(logit)),
    )  # fmt: skip
    return weights.reshape(logit.shape)


def _plain_composited(logit: Tensor) -> Tensor:
    passed = torch.cumprod(torch.nn.functional.pad(torch.sigmoid(-logit), (1, 0), value=1.0), dim=1)
    return passed[:, :-1] * torch.sigmoid(logit)


def _logits() -> Reading:
    rng = np.random.default_rng(2)
    logits = rng.uniform(-20.0, 20.0, (64, 24)) * rng.choice([1.0, 0.2, 5.0], (64, 1))
    logits[0] = np.repeat([-math.inf, -1e30, -100.0, 0.0, 100.0, 1e30, 3.0, -math.inf], 3)
    exact = by_autograd(_plain_composited)
    return against(_composited, exact, [logits], scale=1.0, gradient_scale=1.0, has_cuda=False)


def _samples() -> float:
    """Ascending, inside, lengths not negative, jittered or not; without jitter evenly spaced."""
    rng = np.random.default_rng(5)
    near = torch.from_numpy(10.0 ** rng.uniform(-8, 3, 400)).float()
    length = 10.0 ** rng.uniform(-8, 8, 400) * (rng.random(400) > 0.1)
    far = torch.maximum(near + torch.from_numpy(length).float(), near)
    for generator in (torch.Generator().manual_seed(0), None):
        t, delta = uniform_samples(near, far, 768, generator)
        assert bool(torch.isfinite(t).all() and (t >= near[:, None]).all() and (t <= far[:, None]).all())
        assert bool((t.diff(dim=1) >= 0).all() and (delta >= 0).all()), "samples do not ascend"
    exact = near.double()[:, None] + (far - near).double()[:, None] * torch.linspace(0, 1, 768).double()
    return largest(t.double() / far.double()[:, None], exact / far.double()[:, None]) / EPS


def _expected_range(total_depth: float) -> Reading:
    """The range of eq. 3, which is not divided by the weights' sum, of rays of some optical depth."""
    depths = np.random.default_rng(0).random((200, 768)) ** 8
    depths *= total_depth / depths.sum(axis=1, keepdims=True)
    near, far = torch.full((200,), 0.02), torch.full((200,), 1.6)
    t, delta = uniform_samples(near, far, 768)
    rays = ScaledRays(torch.zeros(200, 3), torch.eye(3)[:1].expand(200, 3), near, far)

    def rendered(sigma: Tensor) -> Tensor:
        nothing = sigma.new_zeros(sigma.numel(), 1)
        return render_volume(
            lambda _: (sigma.reshape(-1), nothing), lambda towards, _: towards[:, :1], rays.to(sigma.device),
            samples=768, bound=1.0,
        ).range_scaled  # fmt: skip

    plain = by_autograd(
        lambda sigma: (_plain_weights(sigma * delta.double())[:, :-1] * t.double()).sum(dim=1)
    )
    return against(rendered, plain, [depths / delta.double().numpy()], gradient_scale=float(delta.max()))


def _median() -> float:
    """Against sums in float64: how far from the middle of the weight the chosen sample's stretch lies."""
    dense = np.random.default_rng(1).random((200, 768)) ** 8
    two = np.zeros((2001, 768))
    two[:, 100], two[:, 700] = np.linspace(0.4, 0.6, 2001), np.linspace(0.6, 0.4, 2001)
    worst = 0.0
    for shares in (dense / dense.sum(axis=1)[:, None], 1e-6 * dense / dense.sum(axis=1)[:, None], two):
        weights = shares.astype(np.float32)
        sums = np.pad(weights.astype(np.float64).cumsum(axis=1), ((0, 0), (1, 0)))
        sums /= sums[:, -1:]
        chosen, ray = weighted_median_index(weights), np.arange(len(weights))
        worst = max(worst, (0.5 - sums[ray, chosen + 1]).max(), (sums[ray, chosen] - 0.5).max())
    assert not weighted_median_index(np.zeros((5, 768))).any(), "not index 0 without any weight"
    return float(worst) / EPS


def _depth_loss() -> Reading:
    """Rays of weight 0, 1e-6, 1/2 and 1 over 24 surfaces, up to 1e6 m off a return at 10.25 m."""
    rng = np.random.default_rng(6)
    weights = rng.dirichlet(np.ones(24), 400) * np.repeat([0.0, 1e-6, 0.5, 1.0], 100)[:, None]
    ranges = 10.25 + 10.0 ** rng.uniform(-6.0, 6.0, (400, 24)) * rng.choice([-1.0, 0.0, 1.0], (400, 24))

    def plain(w: Tensor, t: Tensor) -> Tensor:
        return (w * (t - 10.25).abs().clamp(max=CLAMP_M)).sum(dim=1) + CLAMP_M * (1.0 - w.sum(dim=1))

    return against(lambda w, t: depth_loss(w, t, t.new_full((400,), 10.25)), by_autograd(plain),
                   [weights, ranges], scale=CLAMP_M)  # fmt: skip


def _sampled(near: float, far: float) -> object:
    return uniform_samples(torch.tensor([near]), torch.tensor([far]), 8)


_WEIGHTS, _SAMPLES = "rendering.volume.weights_from_optical_depth", "rendering.volume.uniform_samples"
_MEDIAN, _VOLUME = "evidence.surfels.weighted_median_index", "rendering.volume.render_volume"
CASES = (
    Case("numerics.safe_exp", "every float32; -110 to 60 by 0.1: subnormals, saturation at 40; NaN stays NaN",
         _safe_exp, ELEMENTWISE_ULP, "ulp"),
    Case("numerics.probability_logit", "every float32; 0 to 1 closely; NaN stays NaN", _probability_logit,
         ELEMENTWISE_ULP, "ulp"),
    Case("fields.layers.Density", "features ±1e4", _density),
    Case(_WEIGHTS, "one sample, τ = 0 and 1e-8 to 80", _one_sample, ELEMENTWISE_ULP, "ulp"),
    Case(_WEIGHTS, "96 samples, τ 1e-16 to 1e8 on one ray", _mixed, SUM_EPS, "ulp"),
    Case(_WEIGHTS, "768 samples, τ 1e-8 to 1e-3: a product of 1 - τ would leave 1", _thin, SUM_EPS, "ulp"),
    Case(_WEIGHTS, "opaque walls: τ = inf, 1e38, sums beyond float32", _opaque),
    Case(_WEIGHTS, "768 samples, τ 1e-8 to 1e4: weights and what is left sum to 1", _sums, SUM_EPS, "eps"),
    Case(_WEIGHTS, "zero-length and repeated intervals, σ up to 1e17", _zero_length, 1e-6),
    Case(_WEIGHTS, "τ = -1 (outside)",
         refused(DivergedError, lambda: weights_from_optical_depth(torch.tensor([[-1.0]])))),
    Case("kernels.composite.composite_rays", "24 logits of ±100, ±1e30 and -inf", _logits, SUM_EPS, "ulp"),
    Case(_SAMPLES, "near 1e-8 to 1e3, length 0 to 1e8, 768 samples, with and without jitter", _samples,
         ELEMENTWISE_ULP, "eps of far"),
    Case(_SAMPLES, "far = inf (outside)", refused(DataError, lambda: _sampled(1.0, math.inf))),
    Case(_SAMPLES, "NaN (outside)", refused(DataError, lambda: _sampled(math.nan, 1.0))),
    Case(_SAMPLES, "far < near (outside)", refused(DataError, lambda: _sampled(2.0, 1.0))),
    Case(_VOLUME, "range of 768 samples, optical depth 30", lambda: _expected_range(30.0), SUM_EPS, "ulp"),
    Case(_VOLUME, "range in thin air, optical depth 1e-6", lambda: _expected_range(1e-6), SUM_EPS, "ulp"),
    Case(_MEDIAN, "768 weights of sum 1, 1e-6, 0; two surfaces", _median, SUM_EPS, "eps"),
    Case("losses.lidar.depth_loss", "weights of sum 0, 1e-6, 1/2 and 1; errors 0 to 1e6 m", _depth_loss,
         ELEMENTWISE_ULP, "ulp of 3 m"),
)  # fmt: skip
