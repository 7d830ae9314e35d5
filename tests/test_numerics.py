"""Laws of the bounded operations: finite in value and gradient over the whole float range."""

import math
from functools import partial

import pytest
import torch

from nvsf_core import numerics
from nvsf_core.errors import DivergedError

_LARGEST = torch.finfo(torch.float32).max
_POSITIVE = torch.cat(
    [
        torch.tensor([0.0, 1e-45, torch.finfo(torch.float32).tiny]),
        torch.logspace(-44, 38, 500),
        torch.linspace(0, 120, 500),
        torch.tensor([1.0, _LARGEST]),
    ]
)
WHOLE_RANGE = torch.cat([_POSITIVE, -_POSITIVE])

UNARY = [numerics.safe_exp, partial(numerics.probability_logit, margin=0.003)]


@pytest.mark.parametrize("function", UNARY)
def test_value_and_gradient_are_finite_over_the_whole_float_range(function):
    x = WHOLE_RANGE.clone().requires_grad_()
    y = function(x)
    y.sum().backward()
    assert torch.isfinite(y).all()
    assert torch.isfinite(x.grad).all()
    assert x.grad.abs().max() <= math.exp(numerics.EXP_GRADIENT_LIMIT) * 1.0001


@pytest.mark.parametrize("function", UNARY)
def test_nan_stays_nan(function):
    assert torch.isnan(function(torch.tensor([math.nan]))).all()


@pytest.mark.parametrize(
    ("function", "low", "high"),
    [
        (numerics.safe_exp, -14.0, 14.0),
        (UNARY[1], 0.01, 0.99),
    ],
)
def test_gradients_are_derivatives_inside_the_interval(function, low, high):
    x = torch.linspace(low, high, 40, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(function, (x,), eps=1e-7, rtol=1e-4)


def test_safe_exp_saturates_where_it_says():
    x = torch.tensor([-1e9, 0.0, 40.0, 41.0, math.inf]).requires_grad_()
    y = numerics.safe_exp(x)
    y.sum().backward()
    top = math.exp(numerics.EXP_SATURATION)
    assert y.tolist() == pytest.approx([0.0, 1.0, top, top, top], rel=1e-5)
    steep = math.exp(numerics.EXP_GRADIENT_LIMIT)
    assert x.grad.tolist() == pytest.approx([1 / steep, 1.0, steep, steep, steep], rel=1e-5)


def test_the_logit_is_bounded_by_its_margin():
    logits = numerics.probability_logit(torch.tensor([-1.0, 0.0, 0.5, 1.0, 2.0]), 0.02)
    assert logits.tolist() == pytest.approx([-3.8918, -3.8918, 0.0, 3.8918, 3.8918], abs=1e-4)
    with pytest.raises(ValueError, match="margin"):
        numerics.probability_logit(torch.tensor([0.5]), margin=0.0)


def test_the_finite_pass_and_the_others_are_named():
    tensor = torch.ones(2, 3)
    assert numerics.require_finite("density", tensor) is tensor
    tensor[1, 2] = math.nan
    with pytest.raises(DivergedError, match=r"density.*1 of 6.*\(1, 2\)"):
        numerics.require_finite("density", tensor)
    with pytest.raises(DivergedError, match="loss"):
        numerics.require_finite("loss", torch.tensor(math.inf))
