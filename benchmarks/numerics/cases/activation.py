"""Density activation and the other operations that can blow up, over the whole float range."""

import math

import mpmath
import numpy as np
import torch

from benchmarks.numerics.cases.case import Case, Reading, refused
from benchmarks.numerics.cases.references import against, by_mpmath, every_float
from nvsf_core import numerics
from nvsf_core.errors import DivergedError
from nvsf_core.fields.density import Density
from nvsf_core.recipe import HeadsSpec

TITLE = "Density activation and guarded operations"
_COUNT = 600
_LEAST = mpmath.mpf(1) / mpmath.mpf(numerics.GRADIENT_LIMIT)
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


def _safe_log() -> Reading:
    floor = mpmath.mpf(1e-12)
    reference = by_mpmath(
        lambda x: mpmath.log(max(x, floor)), lambda x: 1 / x if x > floor else mpmath.mpf(0)
    )
    return against(numerics.safe_log, reference, [every_float(_COUNT)])


def _safe_sqrt() -> Reading:
    reference = by_mpmath(
        lambda x: mpmath.sqrt(max(x, 0)),
        lambda x: mpmath.mpf(0) if x < 0 else 1 / (2 * mpmath.sqrt(max(x, mpmath.mpf(1e-12)))),
    )
    return against(numerics.safe_sqrt, reference, [every_float(_COUNT)])


def _log_opacity(x: mpmath.mpf) -> mpmath.mpf:
    return mpmath.log(-mpmath.expm1(-max(x, _LEAST)))


def _log_opacity_slope(x: mpmath.mpf) -> mpmath.mpf:
    return mpmath.mpf(0) if x < _LEAST or x > 1e5 else 1 / mpmath.expm1(x)


def _log1mexp() -> Reading:
    numbers = np.concatenate([every_float(_COUNT), np.geomspace(1e-17, 100.0, 400), [math.log(2.0)]])
    return against(numerics.log1mexp, by_mpmath(_log_opacity, _log_opacity_slope), [numbers])


def _softplus_inverse() -> Reading:
    numbers = np.concatenate([every_float(_COUNT, low=0.0), np.geomspace(1e-17, 100.0, 400)])
    # Near y = ln 2 the result passes through 0: there its error is counted at the last place of 1.
    reference = by_mpmath(lambda y: y + _log_opacity(y), lambda y: 1 + _log_opacity_slope(y))
    large = numbers[(numbers < 0.4) | (numbers > 1.2)]
    near = against(numerics.softplus_inverse, reference, [np.linspace(0.4, 1.2, 200)], scale=1.0)
    far = against(numerics.softplus_inverse, reference, [large])
    return near if not near.is_ok else far


def _probability_logit() -> Reading:
    low, high = mpmath.mpf(np.float32(1e-6).item()), mpmath.mpf(1) - mpmath.mpf(np.float32(1e-6).item())

    def value(p: mpmath.mpf) -> mpmath.mpf:
        p = min(max(p, low), high)
        return mpmath.log(p / (1 - p))

    def slope(p: mpmath.mpf) -> mpmath.mpf:
        return 1 / (p * (1 - p)) if low <= p <= high else mpmath.mpf(0)

    numbers = np.concatenate([every_float(300), np.linspace(0.002, 0.45, 300), np.linspace(0.55, 0.998, 300)])
    # Two logarithms of up to 13.8 are subtracted: errors count at the last place of that.
    return against(numerics.probability_logit, by_mpmath(value, slope), [numbers], scale=13.8)


def _safe_div() -> Reading:
    few = every_float(120, seed=3)
    top, bottom = (a.reshape(-1) for a in np.meshgrid(few, few))
    limit, floor = numerics.GRADIENT_LIMIT, 1e-12

    def reference(inputs):  # type: ignore[no-untyped-def]
        a, b = inputs
        bounded = np.where(b < 0, -1.0, 1.0) * np.maximum(np.abs(b), floor)
        quotient = np.clip(a / bounded, -limit, limit)
        to_b = np.where(np.abs(b) < floor, 0.0, np.clip(-quotient / bounded, -limit, limit))
        return quotient, [np.clip(1.0 / bounded, -limit, limit), to_b]

    return against(numerics.safe_div, reference, [top, bottom])


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
    names = ("safe_exp", "safe_log", "safe_sqrt", "log1mexp", "softplus_inverse", "probability_logit")
    lost = [name for name in names if not getattr(numerics, name)(torch.tensor([math.nan])).isnan().all()]
    return Reading(outcome=f"NaN comes out of all but {lost}", float32="ok", is_refuted=bool(lost))


CASES = (
    Case("numerics.safe_exp", _ALL, _safe_exp),
    Case("numerics.safe_exp", "-110 to 60 by 0.1: subnormals, saturation at 40", _safe_exp_range),
    Case("numerics.safe_log", _ALL, _safe_log),
    Case("numerics.safe_sqrt", _ALL, _safe_sqrt),
    Case("numerics.log1mexp", f"{_ALL}; 1e-17 to 100 closely", _log1mexp),
    Case("numerics.softplus_inverse", "0 to 3.4e38", _softplus_inverse),
    Case("numerics.probability_logit", f"{_ALL}; 0 to 1 closely", _probability_logit),
    Case("numerics.safe_div", f"both: {_ALL}", _safe_div),
    Case("fields.density.Density", "features ±1e4", _density),
    Case("numerics.*", "NaN (outside)", _nan),
    Case(
        "numerics.require_finite", "NaN, ±inf (outside)",
        lambda: refused(
            DivergedError, lambda: numerics.require_finite("density", torch.tensor([1.0, math.nan]))
        ),
    ),
    Case(
        "numerics.safe_log", "floor 0 (outside)",
        lambda: refused(ValueError, lambda: numerics.safe_log(torch.ones(1), floor=0.0)),
    ),
)  # fmt: skip
