"""Laws of the bounded operations: finite in value and gradient over the whole float range."""

import math

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

UNARY = [
    numerics.safe_exp,
    numerics.safe_log,
    numerics.safe_sqrt,
    numerics.log1mexp,
    numerics.softplus_inverse,
    numerics.probability_logit,
]


@pytest.mark.parametrize("function", UNARY)
def test_value_and_gradient_are_finite_over_the_whole_float_range(function):
    x = WHOLE_RANGE.clone().requires_grad_()
    y = function(x)
    y.sum().backward()
    assert torch.isfinite(y).all()
    assert torch.isfinite(x.grad).all()
    assert x.grad.abs().max() <= numerics.GRADIENT_LIMIT * 1.0001


def test_division_is_finite_over_the_whole_float_range_of_both():
    few = WHOLE_RANGE[::7]
    numerator = few[:, None].expand(-1, len(few)).clone().requires_grad_()
    denominator = few[None, :].expand(len(few), -1).clone().requires_grad_()
    quotient = numerics.safe_div(numerator, denominator)
    quotient.sum().backward()
    for tensor in (quotient, numerator.grad, denominator.grad):
        assert torch.isfinite(tensor).all()
        assert tensor.abs().max() <= numerics.GRADIENT_LIMIT * 1.0001


@pytest.mark.parametrize(
    "function", [*UNARY, lambda x: numerics.safe_div(x, x), lambda x: numerics.safe_div(1.0 + 0 * x, x)]
)
def test_nan_stays_nan(function):
    assert torch.isnan(function(torch.tensor([math.nan]))).all()


@pytest.mark.parametrize(
    ("function", "low", "high"),
    [
        (numerics.safe_exp, -14.0, 14.0),
        (numerics.safe_log, 1e-3, 1e3),
        (numerics.safe_sqrt, 1e-3, 1e3),
        (numerics.log1mexp, 1e-2, 20.0),
        (numerics.softplus_inverse, 1e-2, 40.0),
        (numerics.probability_logit, 0.01, 0.99),
    ],
)
def test_gradients_are_derivatives_inside_the_interval(function, low, high):
    x = torch.linspace(low, high, 40, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(function, (x,), eps=1e-7, rtol=1e-4)


def test_division_is_division_and_broadcasts():
    generator = torch.Generator().manual_seed(0)
    a = torch.randn(4, 1, 3, dtype=torch.float64, generator=generator).requires_grad_()
    b = (torch.randn(5, 1, dtype=torch.float64, generator=generator) + 3.0).requires_grad_()
    assert torch.allclose(numerics.safe_div(a, b), a / b)
    assert torch.autograd.gradcheck(numerics.safe_div, (a, b))


def test_division_keeps_the_sign_of_a_tiny_denominator():
    quotient = numerics.safe_div(torch.tensor([1.0, 1.0, 0.0]), torch.tensor([1e-30, -1e-30, 0.0]))
    assert quotient.tolist() == pytest.approx([1e12, -1e12, 0.0])


def test_safe_exp_saturates_where_it_says():
    x = torch.tensor([-1e9, 0.0, 40.0, 41.0, math.inf]).requires_grad_()
    y = numerics.safe_exp(x)
    y.sum().backward()
    top = math.exp(numerics.EXP_SATURATION)
    assert y.tolist() == pytest.approx([0.0, 1.0, top, top, top], rel=1e-5)
    steep = math.exp(numerics.EXP_GRADIENT_LIMIT)
    assert x.grad.tolist() == pytest.approx([1 / steep, 1.0, steep, steep, steep], rel=1e-5)


def test_small_arguments_keep_their_digits_in_float32():
    depth = torch.tensor([1e-10, 1e-5, 0.5, 20.0])
    exact = [math.log(-math.expm1(-d)) for d in depth.double().tolist()]
    assert numerics.log1mexp(depth).tolist() == pytest.approx(exact, rel=1e-6, abs=1e-12)


def test_softplus_undoes_its_inverse():
    y = torch.logspace(-10, 10, 200, dtype=torch.float64)
    again = torch.nn.functional.softplus(numerics.softplus_inverse(y), threshold=50)
    assert torch.allclose(again, y, rtol=1e-9)


def test_square_root_is_exact_at_zero_and_forgives_rounding():
    assert numerics.safe_sqrt(torch.tensor([0.0, -1e-9, 4.0])).tolist() == [0.0, 0.0, 2.0]


def test_the_logit_is_bounded_by_its_margin():
    logits = numerics.probability_logit(torch.tensor([-1.0, 0.0, 0.5, 1.0, 2.0]))
    assert logits.tolist() == pytest.approx([-13.8155, -13.8155, 0.0, 13.8155, 13.8155], abs=0.02)
    with pytest.raises(ValueError, match="margin"):
        numerics.probability_logit(torch.tensor([0.5]), margin=0.0)


def test_a_floor_that_cannot_bound_the_gradient_is_refused():
    with pytest.raises(ValueError, match="safe_log"):
        numerics.safe_log(torch.ones(1), floor=0.0)


def test_the_finite_pass_and_the_others_are_named():
    tensor = torch.ones(2, 3)
    assert numerics.require_finite("density", tensor) is tensor
    tensor[1, 2] = math.nan
    with pytest.raises(DivergedError, match=r"density.*1 of 6.*\(1, 2\)"):
        numerics.require_finite("density", tensor)
    with pytest.raises(DivergedError, match="loss"):
        numerics.require_finite("loss", torch.tensor(math.inf))
