"""Numerically safe versions of operations that could overflow or divide by 0.

For every finite input the value is finite, and the derivative is at most ``GRADIENT_LIMIT``. NaN stays NaN;
`require_finite` turns it into an error with a name. float16 and bfloat16 are computed in float32 and rounded
once; values and gradients beyond their largest number become that number.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import torch
from torch import Tensor

from nvsf_core.errors import DivergedError

EXP_SATURATION = 40.0
"""`safe_exp` is exp up to here and constant above: e^40 = 2.4e17, whose square still fits into float32."""

EXP_GRADIENT_LIMIT = 15.0
"""The gradient of `safe_exp` is exp of the input clamped to plus/minus this (as trunc_exp of NVSF's code)."""

GRADIENT_LIMIT = 1e18
"""Largest derivative of any function here."""


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
    """The tensor in a narrower type; values beyond its largest number become that number."""
    largest = torch.finfo(dtype).max
    return x.clamp(-largest, largest).to(dtype)


def _at_least_single(function: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """Apply a function in float32 to a tensor of a half type, else in the tensor's own type."""
    if x.dtype not in (torch.float16, torch.bfloat16):
        return function(x)
    return cast(Tensor, _Narrow.apply(function(_Widen.apply(x)), x.dtype))  # type: ignore[no-untyped-call]


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
    """Exponential without overflow, whose gradient neither vanishes nor explodes.

    Value ``exp(min(x, 40))``; gradient ``exp(clamp(x, -15, 15))``, that is 3e-7 to 3e6.

    Args:
        x: Any shape, floating.

    Returns:
        Same shape, in [0, 2.4e17].
    """
    return _at_least_single(_SafeExp.apply, x)


def probability_logit(probability: Tensor, margin: float) -> Tensor:
    """``log(p / (1 - p))`` of p clamped to [margin, 1 - margin]; gradient 0 where it was clamped.

    Args:
        probability: Any shape, floating.
        margin: In [1e-3, 0.5); near 1 a smaller one would be imprecise in float32.

    Returns:
        Same shape, within plus/minus ``log((1 - margin) / margin)``.

    Raises:
        ValueError: The margin is outside its interval.
    """
    if not 1e-3 <= margin < 0.5:
        raise ValueError(f"probability_logit: expected a margin in [1e-3, 0.5), found {margin}")
    return _at_least_single(lambda p: torch.logit(p.clamp(margin, 1.0 - margin)), probability)


def require_finite(name: str, tensor: Tensor) -> Tensor:
    """Return the tensor itself if all of it is finite.

    Args:
        name: What the tensor is (loss term, step), for the message.
        tensor: Any shape.

    Raises:
        DivergedError: It holds NaN or infinity; the message says how many, and where the first is.
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
