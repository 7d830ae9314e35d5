"""Comparing a torch function with a reference that shares no code with it, in every data type."""

import math
from collections.abc import Callable, Sequence

import mpmath
import numpy as np
import torch
from torch import Tensor

from benchmarks.numerics.cases.case import NOT_APPLICABLE, NOT_ON_GPU, Gradient, Reading
from benchmarks.numerics.cases.tolerances import TOLERANCES

__all__ = ["Reference", "against", "by_autograd", "by_mpmath", "every_float", "unit_in_last_place"]

HALVES = (torch.bfloat16, torch.float16)
_DIGITS = 60

Reference = Callable[[Sequence[np.ndarray]], tuple[np.ndarray, list[np.ndarray]]]
"""Inputs in float64 to the value in float64 and, for each input, the gradient of the value's sum."""


def every_float(count: int, seed: int = 0, *, low: float = -math.inf, high: float = math.inf) -> np.ndarray:
    """Finite float32 drawn evenly over their bit patterns, so over all magnitudes, and the special ones."""
    bits = np.random.default_rng(seed).integers(0, 1 << 32, 4 * count, dtype=np.uint64).astype(np.uint32)
    info = np.finfo(np.float32)
    special = [0.0, info.tiny, info.smallest_subnormal, info.max, 1.0, info.eps, 1e4, 88.0, 89.0, 40.0, 15.0]
    drawn = bits.view(np.float32)
    finite = drawn[np.isfinite(drawn)].astype(np.float64)
    numbers = np.concatenate([finite, special, np.negative(special)])
    kept: np.ndarray = numbers[(numbers >= low) & (numbers <= high)]
    return kept[-count:]


def by_mpmath(
    function: Callable[[mpmath.mpf], mpmath.mpf], slope: Callable[[mpmath.mpf], mpmath.mpf]
) -> Reference:
    """A function of one number and its derivative, in 60 digits."""

    def reference(inputs: Sequence[np.ndarray]) -> tuple[np.ndarray, list[np.ndarray]]:
        with mpmath.workdps(_DIGITS):
            points = [mpmath.mpf(float(x)) for x in inputs[0]]
            values = np.array([float(function(x)) for x in points])
            slopes = np.array([float(slope(x)) for x in points])
        return values, [slopes]

    return reference


def by_autograd(formula: Callable[..., Tensor]) -> Reference:
    """Another formula for the same, in float64, differentiated by torch."""

    def reference(inputs: Sequence[np.ndarray]) -> tuple[np.ndarray, list[np.ndarray]]:
        tensors = [torch.from_numpy(np.array(x, np.float64)).requires_grad_() for x in inputs]
        value = formula(*tensors)
        gradients = torch.autograd.grad(value.sum(), tensors, allow_unused=True)
        zero = [np.zeros(x.shape) if g is None else g.numpy() for x, g in zip(inputs, gradients, strict=True)]
        return value.detach().numpy(), zero

    return reference


def unit_in_last_place(magnitude: np.ndarray, dtype: torch.dtype) -> np.ndarray:
    """Distance between neighbouring numbers of a type at some magnitude, float64."""
    info = torch.finfo(dtype)
    _, exponent = np.frexp(np.maximum(np.abs(magnitude), info.tiny))
    unit: np.ndarray = np.ldexp(info.eps, exponent - 1)
    return unit


def against(
    function: Callable[..., Tensor],
    reference: Reference,
    inputs: Sequence[np.ndarray],
    *,
    scale: float | None = None,
    gradient_scale: float = 0.0,
    is_sum: bool = False,
    has_gradient: bool = True,
    halves: Sequence[torch.dtype] = HALVES,
    outcome: str = "",
) -> Reading:
    """Largest error of a function in float32, and how it did in the other types and on CUDA.

    The reference sees each type's own rounding of the inputs, so only the function's errors count. What a
    half type cannot hold is expected at its largest number.

    Args:
        function: Tensors to a tensor.
        reference: The same, independent.
        inputs: float64.
        scale: Magnitude at whose last place errors are counted; None = each value's own.
        gradient_scale: Errors of the gradient count relative to at least this.
        is_sum: Whether roundings of many terms add up.
        has_gradient: Whether to compare gradients.
        halves: Half types that the function takes.
        outcome: Remark for the table.
    """

    def measure(dtype: torch.dtype, device: str) -> Reading:
        slope = gradient_scale if has_gradient else None
        return _measure(function, reference, inputs, dtype, device, scale, slope, is_sum)

    single = measure(torch.float32, "cpu")
    reduced = [_short(measure(half, "cpu"), half) for half in halves]
    failing = [text for text in reduced if text.startswith("fail")]
    cuda = NOT_ON_GPU
    if torch.cuda.is_available():
        cuda = _short(measure(torch.float32, "cuda"), torch.float32)
    return Reading(
        error=single.error, limit=single.limit, unit=single.unit, gradient=single.gradient,
        float32="ok" if single.is_ok else "fail",
        reduced="; ".join(failing or reduced) or NOT_APPLICABLE, cuda=cuda, outcome=outcome,
    )  # fmt: skip


def _short(found: Reading, dtype: torch.dtype) -> str:
    name = {torch.bfloat16: "bf16", torch.float16: "fp16"}.get(dtype, "fp32")
    slope = "" if found.gradient is None else f", gradient {found.gradient.error:.1e}"
    return f"{'' if found.is_ok else 'fail: '}{name} {found.error:.2g} {found.unit}{slope}"


def _measure(
    function: Callable[..., Tensor], reference: Reference, inputs: Sequence[np.ndarray], dtype: torch.dtype,
    device: str, scale: float | None, gradient_scale: float | None, is_sum: bool,
) -> Reading:  # fmt: skip
    tensors = [_cast(x, dtype).to(device).requires_grad_(gradient_scale is not None) for x in inputs]
    exact, slopes = reference([t.detach().cpu().double().numpy() for t in tensors])
    value = function(*tensors)
    largest, allowed = torch.finfo(dtype).max, TOLERANCES[dtype]
    gradient = None
    if gradient_scale is not None:
        found = torch.autograd.grad(value.sum(), tensors, allow_unused=True)
        gradient = _gradient(found, [np.clip(s, -largest, largest) for s in slopes], dtype, gradient_scale)
    exact = np.clip(exact, -largest, largest)
    wrong = np.abs(value.detach().cpu().double().numpy() - exact)
    unit = unit_in_last_place(exact if scale is None else np.full(exact.shape, scale), dtype)
    error = float((wrong / unit).max()) if wrong.size else 0.0
    limit = allowed.sum_eps if is_sum else allowed.elementwise_ulp
    return Reading(error=math.inf if math.isnan(error) else error, limit=limit, unit="ulp", gradient=gradient)


def _cast(values: np.ndarray, dtype: torch.dtype) -> Tensor:
    """In a type, what it cannot hold at its largest number."""
    largest = torch.finfo(dtype).max
    return torch.from_numpy(np.clip(values, -largest, largest)).to(dtype)


def _gradient(
    found: Sequence[Tensor | None], exact: Sequence[np.ndarray], dtype: torch.dtype, scale: float
) -> Gradient:
    """Largest error of the gradients, relative to the larger of the true one and the least normal number."""
    error, finite = 0.0, True
    for tensor, true in zip(found, exact, strict=True):
        values = np.zeros(true.shape) if tensor is None else tensor.cpu().double().numpy()
        finite &= bool(np.isfinite(values).all())
        # What lies below the type's normal numbers is right to within one of them.
        beside = np.maximum(np.abs(values - true) - torch.finfo(dtype).tiny, 0.0)
        error = max(error, float((beside / np.maximum(np.abs(true), max(scale, 1e-300))).max(initial=0.0)))
    return Gradient(finite, error, TOLERANCES[dtype].gradient)
