"""Every operation that can blow up, in the one form the project uses.

Each function states its saturation: for every finite input the value is finite and the factor it
multiplies the incoming gradient with is at most ``GRADIENT_LIMIT``. NaN goes in and comes out as NaN;
`require_finite` is where it becomes an error with a name. float16 and bfloat16 are worked on in float32
and rounded once; values and gradients that they cannot hold come out as their largest number.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import torch
from torch import Tensor

from nvsf_core.errors import DivergedError

__all__ = [
    "EXP_GRADIENT_LIMIT",
    "EXP_SATURATION",
    "GRADIENT_LIMIT",
    "log1mexp",
    "probability_logit",
    "require_finite",
    "safe_div",
    "safe_exp",
    "safe_log",
    "safe_sqrt",
    "softplus_inverse",
]

EXP_SATURATION = 40.0
"""`safe_exp` is exp up to here and constant above: e^40 = 2.4e17, whose square still fits float32."""

EXP_GRADIENT_LIMIT = 15.0
"""The gradient of `safe_exp` is exp of the input clamped to plus/minus this (as NVSF's trunc_exp)."""

GRADIENT_LIMIT = 1e18
"""No function here multiplies a gradient with more than this."""

_LN_2 = 0.6931471805599453
_HALVES = (torch.float16, torch.bfloat16)


class _Widen(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.dtype = x.dtype
        return x.float()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        return _fitting(grads[0], ctx.dtype)


class _Narrow(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, dtype: torch.dtype) -> Tensor:
        return _fitting(x, dtype)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        return grads[0].float(), None


def _fitting(x: Tensor, dtype: torch.dtype) -> Tensor:
    """In a narrower type: what it cannot hold becomes its largest number."""
    largest = torch.finfo(dtype).max
    return x.clamp(-largest, largest).to(dtype)


def _at_least_single(function: Callable[..., Tensor], *tensors: Tensor) -> Tensor:
    """Apply a function in float32 where the tensors are half types, else as they are."""
    dtype = torch.result_type(tensors[0], tensors[-1])
    if dtype not in _HALVES:
        return function(*tensors)
    wide = [cast(Tensor, _Widen.apply(x)) for x in tensors]  # type: ignore[no-untyped-call]
    return cast(Tensor, _Narrow.apply(function(*wide), dtype))  # type: ignore[no-untyped-call]


class _SafeExp(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return torch.exp(x.clamp(max=EXP_SATURATION))

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors
        return grads[0] * torch.exp(x.clamp(-EXP_GRADIENT_LIMIT, EXP_GRADIENT_LIMIT))


def safe_exp(x: Tensor) -> Tensor:
    """Exponential that neither overflows nor goes deaf.

    Value ``exp(min(x, 40))``; gradient ``exp(clamp(x, -15, 15))``, so an input far below still learns
    (3e-7) and one far above does not tear the weights apart (3e6).

    Args:
        x: any shape, floating.

    Returns:
        Same shape, in [0, 2.4e17].
    """
    return _at_least_single(_SafeExp.apply, x)


def safe_log(x: Tensor, floor: float = 1e-12) -> Tensor:
    """``log(max(x, floor))``; gradient ``1/x`` above the floor and 0 below it.

    Args:
        x: any shape, floating.
        floor: smallest argument of the logarithm, in [1/GRADIENT_LIMIT, ...).

    Returns:
        Same shape, at least ``log(floor)``.
    """
    _require_floor(floor, "safe_log")
    return _at_least_single(lambda y: torch.log(y.clamp(min=floor)), x)


class _SafeDiv(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, numerator: Tensor, denominator: Tensor, floor: float) -> Tensor:
        sign = torch.where(denominator < 0, -1.0, 1.0).to(denominator.dtype)
        bounded = sign * denominator.abs().clamp(min=floor)
        quotient = (numerator / bounded).clamp(-GRADIENT_LIMIT, GRADIENT_LIMIT)
        ctx.save_for_backward(bounded, quotient, denominator.abs() < floor)
        ctx.shapes = (numerator.shape, denominator.shape)
        return quotient

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor, None]:
        bounded, quotient, floored = ctx.saved_tensors
        to_numerator = (1.0 / bounded).clamp(-GRADIENT_LIMIT, GRADIENT_LIMIT)
        to_denominator = (-quotient / bounded).clamp(-GRADIENT_LIMIT, GRADIENT_LIMIT)
        to_denominator = torch.where(floored, torch.zeros_like(to_denominator), to_denominator)
        numerator_shape, denominator_shape = ctx.shapes
        return (
            (grads[0] * to_numerator).sum_to_size(numerator_shape),
            (grads[0] * to_denominator).sum_to_size(denominator_shape),
            None,
        )


def safe_div(numerator: Tensor, denominator: Tensor, floor: float = 1e-12) -> Tensor:
    """``numerator / denominator`` with the denominator kept ``floor`` away from 0, its sign preserved.

    The quotient saturates at plus/minus ``GRADIENT_LIMIT``; 0/0 is 0. The denominator receives no
    gradient while it is inside the floor. Shapes broadcast.

    Args:
        numerator: any shape, floating.
        denominator: any shape that broadcasts with it; a zero counts as positive.
        floor: smallest magnitude of the denominator, in [1/GRADIENT_LIMIT, ...).

    Returns:
        The broadcast shape, within plus/minus 1e18.
    """
    _require_floor(floor, "safe_div")
    return _at_least_single(lambda a, b: _SafeDiv.apply(a, b, floor), numerator, denominator)  # type: ignore[no-untyped-call]


class _SafeSqrt(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, floor: float) -> Tensor:
        ctx.save_for_backward(x)
        ctx.floor = floor
        return torch.sqrt(x.clamp(min=0.0))

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        (x,) = ctx.saved_tensors
        slope = 0.5 / torch.sqrt(x.clamp(min=ctx.floor))
        return grads[0] * torch.where(x < 0, torch.zeros_like(slope), slope), None


def safe_sqrt(x: Tensor, floor: float = 1e-12) -> Tensor:
    """``sqrt(max(x, 0))``, exactly 0 at 0; the gradient is ``0.5/sqrt(max(x, floor))``, 0 for negatives.

    Args:
        x: any shape, floating; negatives are rounding errors of something that cannot be negative.
        floor: where the slope stops growing, in [1/GRADIENT_LIMIT, ...).

    Returns:
        Same shape, at least 0.
    """
    _require_floor(floor, "safe_sqrt")
    return _at_least_single(lambda y: _SafeSqrt.apply(y, floor), x)  # type: ignore[no-untyped-call]


class _Log1mExp(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        bounded = x.clamp(min=1.0 / GRADIENT_LIMIT)
        ctx.save_for_backward(x, bounded)
        # expm1 is exact where 1 - exp(-x) is small, log1p where exp(-x) is: they swap at ln 2.
        return torch.where(
            bounded < _LN_2, torch.log(-torch.expm1(-bounded)), torch.log1p(-torch.exp(-bounded))
        )

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        x, bounded = ctx.saved_tensors
        slope = (1.0 / torch.expm1(bounded)).clamp(max=GRADIENT_LIMIT)
        return grads[0] * torch.where(x < 1.0 / GRADIENT_LIMIT, torch.zeros_like(slope), slope)


def log1mexp(x: Tensor) -> Tensor:
    """``log(1 - exp(-x))`` for x > 0: the log of the opacity that belongs to the optical depth x.

    Saturates below x = 1e-18 at -41.4 with gradient 0 (so do all x <= 0); gradient ``1/expm1(x)``.

    Args:
        x: any shape, floating.

    Returns:
        Same shape, in [-41.4, 0].
    """
    return _at_least_single(_Log1mExp.apply, x)


def softplus_inverse(y: Tensor) -> Tensor:
    """The x with ``log(1 + exp(x)) = y``: ``y + log(1 - exp(-y))``, without exp(y).

    Saturates below y = 1e-18 (x = -41.4), where softplus is 0 for every purpose.

    Args:
        y: any shape, floating, positive.

    Returns:
        Same shape.
    """
    return _at_least_single(lambda x: x + log1mexp(x), y)


def probability_logit(probability: Tensor, margin: float = 1e-6) -> Tensor:
    """``log(p / (1 - p))`` of p clamped to [margin, 1 - margin]; gradient 0 where it was clamped.

    Args:
        probability: any shape, floating.
        margin: in [1e-6, 0.5); smaller ones round away beside 1 in float32.

    Returns:
        Same shape, within plus/minus ``log((1 - margin)/margin)`` (13.8 by default).

    Raises:
        ValueError: the margin is outside its interval.
    """
    if not 1e-6 <= margin < 0.5:
        raise ValueError(f"probability_logit: expected a margin in [1e-6, 0.5), found {margin}")
    low, high = margin, 1.0 - margin
    # 1 - p is exact for p above a half; clamped by itself, since 1 - margin is not a float32.
    return _at_least_single(
        lambda p: torch.log(p.clamp(low, high)) - torch.log((1.0 - p).clamp(low, high)), probability
    )


def require_finite(name: str, tensor: Tensor) -> Tensor:
    """Hand the tensor back if all of it is finite.

    Args:
        name: what the tensor is, for the message (loss term, step).
        tensor: any shape.

    Returns:
        The same tensor.

    Raises:
        DivergedError: it holds NaN or infinity; names the tensor, how many, and where the first is.
    """
    finite = torch.isfinite(tensor)
    if bool(finite.all()):
        return tensor
    bad = ~finite
    first = tuple(int(i) for i in bad.nonzero()[0])
    raise DivergedError(
        f"{name}: expected finite numbers, found {int(bad.sum())} of {tensor.numel()} NaN or infinite "
        f"(shape {tuple(tensor.shape)}), the first {tensor[first].item()} at index {first}; "
        "lower the learning rate or look at what feeds this tensor"
    )


def _require_floor(floor: float, function: str) -> None:
    if not floor >= 1.0 / GRADIENT_LIMIT:
        raise ValueError(
            f"{function}: expected a floor of at least {1.0 / GRADIENT_LIMIT}, found {floor}; "
            "a smaller one lets the gradient overflow float32"
        )
