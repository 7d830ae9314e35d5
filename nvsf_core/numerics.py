"""Numerically safe versions of operations that could overflow or divide by 0.

For every finite input the value is finite, and the derivative is at most e^15, 3e6. NaN stays NaN;
`require_finite` turns it into an error with a name.
"""

from __future__ import annotations

from typing import Any, cast

import torch
from torch import Tensor

from nvsf_core.errors import DivergedError

EXP_SATURATION = 40.0
"""`safe_exp` is exp up to here and constant above: e^40 = 2.4e17, whose square still fits into float32."""

EXP_GRADIENT_LIMIT = 15.0
"""The gradient of `safe_exp` is exp of the input clamped to plus/minus this (as trunc_exp of NVSF's code)."""


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
    return cast(Tensor, _SafeExp.apply(x))  # type: ignore[no-untyped-call]


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
    return torch.logit(probability.clamp(margin, 1.0 - margin))


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
