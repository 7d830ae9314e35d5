"""Compares a torch function in float32 with a reference in float64 or mpmath that shares no code with it."""

import math
from collections.abc import Callable, Sequence

import mpmath
import numpy as np
import torch
from torch import Tensor

from benchmarks.numerics.cases.case import NOT_APPLICABLE, NOT_ON_GPU, Reading
from benchmarks.numerics.cases.tolerances import GRADIENT

_DIGITS = 60
_SINGLE = torch.finfo(torch.float32)

Reference = Callable[[Sequence[np.ndarray]], tuple[np.ndarray, list[np.ndarray]]]
"""Inputs in float64 to the value in float64 and, for each input, the gradient of the value's sum."""


def every_float(count: int) -> np.ndarray:
    """Finite float32 drawn evenly over their bit patterns, so over all magnitudes, and the special ones."""
    bits = np.random.default_rng(0).integers(0, 1 << 32, 4 * count, dtype=np.uint64).astype(np.uint32)
    info = np.finfo(np.float32)
    special = [0.0, info.tiny, info.smallest_subnormal, info.max, 1.0, info.eps, 1e4, 88.0, 89.0, 40.0, 15.0]
    drawn = bits.view(np.float32)
    finite = drawn[np.isfinite(drawn)].astype(np.float64)
    kept: np.ndarray = np.concatenate([finite, special, np.negative(special)])[-count:]
    return kept


def by_mpmath(
    function: Callable[[mpmath.mpf], mpmath.mpf], slope: Callable[[mpmath.mpf], mpmath.mpf]
) -> Reference:
    """A function of one number and its derivative, in 60 digits."""

    def reference(inputs: Sequence[np.ndarray]) -> tuple[np.ndarray, list[np.ndarray]]:
        with mpmath.workdps(_DIGITS):
            points = [mpmath.mpf(float(x)) for x in inputs[0].ravel()]
            both = [np.array([float(f(x)) for x in points]) for f in (function, slope)]
        return both[0].reshape(inputs[0].shape), [both[1].reshape(inputs[0].shape)]

    return reference


def by_autograd(formula: Callable[..., Tensor]) -> Reference:
    """Another formula for the same, in float64, differentiated by torch."""

    def reference(inputs: Sequence[np.ndarray]) -> tuple[np.ndarray, list[np.ndarray]]:
        tensors = [torch.from_numpy(np.array(x, np.float64)).requires_grad_() for x in inputs]
        value = formula(*tensors)
        return value.detach().numpy(), [g.numpy() for g in torch.autograd.grad(value.sum(), tensors)]

    return reference


def against(
    function: Callable[..., Tensor], reference: Reference, inputs: Sequence[np.ndarray], *,
    scale: float | None = None, gradient_scale: float | None = 0.0, has_cuda: bool = True,
) -> Reading:  # fmt: skip
    """Largest error of a function in float32, in units in the last place, and of its gradient.

    The reference sees the float32 inputs, so only the function's errors count. What float32 cannot hold is
    expected at its largest number.

    Args:
        function: Tensors to a tensor.
        reference: The same, independent.
        inputs: float64.
        scale: Magnitude at whose last place errors are counted; None = each value's own.
        gradient_scale: Errors of the gradient count relative to at least this; None = no gradient.
        has_cuda: Whether the function takes tensors on CUDA.
    """
    error, gradient = _measured(function, reference, inputs, "cpu", scale, gradient_scale)
    cuda: float | str = NOT_ON_GPU if has_cuda else NOT_APPLICABLE
    if has_cuda and torch.cuda.is_available():
        there, slope = _measured(function, reference, inputs, "cuda", scale, gradient_scale)
        cuda = there if slope is None or slope <= GRADIENT else math.inf
    return Reading(error=error, gradient=gradient, cuda=cuda)


def _measured(
    function: Callable[..., Tensor], reference: Reference, inputs: Sequence[np.ndarray], device: str,
    scale: float | None, gradient_scale: float | None,
) -> tuple[float, float | None]:  # fmt: skip
    tensors = [torch.from_numpy(x).float().to(device) for x in inputs]
    for tensor in tensors:
        tensor.requires_grad_(gradient_scale is not None)
    exact, slopes = reference([t.detach().cpu().double().numpy() for t in tensors])
    value = function(*tensors)
    exact = np.clip(exact, -_SINGLE.max, _SINGLE.max)
    wrong = np.abs(value.detach().cpu().double().numpy() - exact)
    error = float((wrong / _unit_in_last_place(exact if scale is None else np.array(scale))).max())
    if gradient_scale is None:
        return error, None
    found = torch.autograd.grad(value.sum(), tensors)
    return error, max(_slope_error(f, s, gradient_scale) for f, s in zip(found, slopes, strict=True))


def _unit_in_last_place(magnitude: np.ndarray) -> np.ndarray:
    """Distance between neighbouring float32 at some magnitude, float64."""
    _, exponent = np.frexp(np.maximum(np.abs(magnitude), _SINGLE.tiny))
    unit: np.ndarray = np.ldexp(_SINGLE.eps, exponent - 1)
    return unit


def _slope_error(found: Tensor, exact: np.ndarray, scale: float) -> float:
    """Largest error of a gradient, relative to the larger of the true one and the scale."""
    exact = np.clip(exact, -_SINGLE.max, _SINGLE.max)
    values = found.cpu().double().numpy()
    if not np.isfinite(values).all():
        return math.inf
    # What lies below the normal numbers is right to within one of them.
    beside = np.maximum(np.abs(values - exact) - _SINGLE.tiny, 0.0)
    return float((beside / np.maximum(np.abs(exact), max(scale, 1e-300))).max())
