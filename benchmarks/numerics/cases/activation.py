"""Density activation and the other operations that can blow up, over the whole float range."""

import math
from functools import partial

import mpmath
import numpy as np
import torch

from benchmarks.numerics.cases.case import Case, Reading, refused
from benchmarks.numerics.cases.references import against, by_mpmath, every_float
from nvsf_core import numerics
from nvsf_core.errors import DivergedError
from nvsf_core.fields.layers import Density
from nvsf_core.recipe import HeadsSpec

TITLE = "Density activation and guarded operations"
_COUNT = 600
_MARGIN = 0.003
"""The smallest that a hit probability is clamped by."""
_ALL = "every finite float32, ±3.4e38 (fp16: ±65504)"


def _safe_exp() -> Reading:
    reference = by_mpmath(
        lambda x: mpmath.exp(min(x, numerics.EXP_SATURATION)),
        lambda x: mpmath.exp(max(min(x, numerics.EXP_GRADIENT_LIMIT), -numerics.EXP_GRADIENT_LIMIT)),
    )
    return against(numerics.safe_exp, reference, [every_float(_COUNT)])


def _safe_exp_range() -> Reading:
    reference = by_mpmath(
        lambda x: mpmath.exp(min(x, numerics.EXP_SATURATION)),
        lambda x: mpmath.exp(max(min(x, numerics.EXP_GRADIENT_LIMIT), -numerics.EXP_GRADIENT_LIMIT)),
    )
    return against(numerics.safe_exp, reference, [np.linspace(-110.0, 60.0, 1701)])


def _probability_logit() -> Reading:
    low, high = mpmath.mpf(np.float32(_MARGIN).item()), mpmath.mpf(np.float32(1.0 - _MARGIN).item())

    def value(p: mpmath.mpf) -> mpmath.mpf:
        p = min(max(p, low), high)
        return mpmath.log(p / (1 - p))

    def slope(p: mpmath.mpf) -> mpmath.mpf:
        return 1 / (p * (1 - p)) if low <= p <= high else mpmath.mpf(0)

    numbers = np.concatenate([every_float(300), np.linspace(0.002, 0.45, 300), np.linspace(0.55, 0.998, 300)])
    # Its largest value is 5.8: errors count at the last place of that.
    guarded = partial(numerics.probability_logit, margin=_MARGIN)
    return against(guarded, by_mpmath(value, slope), [numbers], scale=5.8)


def _density() -> Reading:
    """The density network with features of ±1e4: its exponent is far outside of what exp takes."""
    network = Density(8, HeadsSpec(), torch.Generator().manual_seed(0))
    with torch.no_grad():
        features = torch.linspace(-1e4, 1e4, 400)[:, None].expand(-1, 8).clone()
    features.requires_grad_()
    sigma, geometry = network(features)
    (sigma.clamp_max(1e3).sum() + geometry.sum()).backward()
    gradients = [features.grad, *(p.grad for p in network.parameters())]
    finite = all(bool(torch.isfinite(g).all()) for g in gradients if g is not None)
    highest = float(sigma.detach().max())
    outcome = f"σ from {float(sigma.detach().min()):.1e} to {highest:.1e}; every gradient finite: {finite}"
    sound = finite and highest <= math.exp(40.0) * 1.001
    return Reading(outcome=outcome, float32="ok" if sound else "fail", is_refuted=not sound)


def _nan() -> Reading:
    logit = partial(numerics.probability_logit, margin=_MARGIN)
    guarded = {"safe_exp": numerics.safe_exp, "probability_logit": logit}
    lost = [name for name, of in guarded.items() if not of(torch.tensor([math.nan])).isnan().all()]
    return Reading(outcome=f"NaN comes out of all but {lost}", float32="ok", is_refuted=bool(lost))


CASES = (
    Case("numerics.safe_exp", _ALL, _safe_exp),
    Case("numerics.safe_exp", "-110 to 60 by 0.1: subnormals, saturation at 40", _safe_exp_range),
    Case("numerics.probability_logit", f"{_ALL}; 0 to 1 closely", _probability_logit),
    Case("fields.density.Density", "features ±1e4", _density),
    Case("numerics.*", "NaN (outside)", _nan),
    Case(
        "numerics.require_finite", "NaN, ±inf (outside)",
        lambda: refused(
            DivergedError, lambda: numerics.require_finite("density", torch.tensor([1.0, math.nan]))
        ),
    ),
)  # fmt: skip
