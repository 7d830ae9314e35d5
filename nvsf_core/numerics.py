"""Numerically guarded operations, each in the one form that the project uses.

Each function states its saturation: for every finite input the value is finite and the factor it
multiplies the incoming gradient with is at most ``GRADIENT_LIMIT``. NaN stays NaN;
`require_finite` makes it a named error. float16 and bfloat16 are computed in float32 and rounded once; values
and gradients too large for them become their largest number.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import torch
from torch import Tensor

from nvsf_core.errors import DivergedError

EXP_SATURATION = 40.0
"""`safe_exp` is exp up to here and constant above: e^40 = 2.4e17, whose square still fits float32."""

EXP_GRADIENT_LIMIT = 15.0
"""The gradient of `safe_exp` is exp of the input clamped to plus/minus this (as NVSF's trunc_exp)."""

GRADIENT_LIMIT = 1e18
"""No function here multiplies a gradient with more than this."""

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
    """Convert to a narrower type; numbers too large for it become its largest one."""
    largest = torch.finfo(dtype).max
    return x.clamp(-largest, largest).to(dtype)


def _at_least_single(function: Callable[..., Tensor], *tensors: Tensor) -> Tensor:
    """Apply a function, in float32 where the tensors are of a half type."""
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
    """Exponential that does not overflow and whose gradient does not vanish.

    Value ``exp(min(x, 40))``; gradient ``exp(clamp(x, -15, 15))``, so it stays between 3e-7
    for very small inputs and 3e6 for very large ones.

    Args:
        x: any shape, floating.

    Returns:
        Same shape, in [0, 2.4e17].
    """
    return _at_least_single(_SafeExp.apply, x)


def probability_logit(probability: Tensor, margin: float) -> Tensor:
    """``log(p / (1 - p))`` of p clamped to [margin, 1 - margin]; gradient 0 where it was clamped.

    Args:
        probability: any shape, floating.
        margin: in [1e-3, 0.5); smaller ones lose digits beside 1 in float32.

    Returns:
        Same shape, within plus/minus ``log((1 - margin)/margin)``.

    Raises:
        ValueError: the margin is outside its interval.
    """
    if not 1e-3 <= margin < 0.5:
        raise ValueError(f"probability_logit: expected a margin in [1e-3, 0.5), found {margin}")
    return _at_least_single(lambda p: torch.logit(p.clamp(margin, 1.0 - margin)), probability)


def require_finite(name: str, tensor: Tensor) -> Tensor:
    """Return the tensor if all of it is finite.

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
