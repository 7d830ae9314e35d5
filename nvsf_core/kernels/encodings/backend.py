"""What encodings share: the choice of the kernel by the tensors' device and type, and its gradients."""

from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from typing import Any, Literal, NamedTuple, cast

import torch
from torch import Tensor

from nvsf_core.errors import ShapeError

Backend = Literal["torch", "numba", "triton"]


class Kernels(NamedTuple):
    """An encoding of n points by a table of features, with sizes given, and its gradients."""

    backend: Backend
    encode: Callable[[Tensor, Tensor], Tensor]
    """Features (n, f) of points (n, d) and a table."""
    position_adjoint: Callable[[Tensor, Tensor, Tensor], Tensor]
    """Gradient (n, d) of the points, of points, table and the gradient (n, f) of the features."""
    table_adjoint: Callable[[Tensor, Tensor], Tensor]
    """Gradient of the table, of points and the gradient (n, f) of the features."""


def choose_backend(points: Tensor, table: Tensor) -> Backend:
    """Numba for float32 points (n, d) and table on the CPU, Triton on CUDA if installed; else the oracle."""
    if points.dtype != torch.float32 or table.dtype != torch.float32:
        return "torch"
    if points.is_cpu:
        return "numba"
    return "triton" if points.is_cuda and _has_triton() else "torch"


def require_backend(backend: Backend, points: Tensor, table: Tensor, *, what: tuple[str, str, str]) -> None:
    """Check that a backend, numba or triton, takes the tensors.

    Args:
        backend: As it was chosen or asked for.
        points: (n, d) to be encoded.
        table: Of the features, of any shape.
        what: Names of the function, the points and the table, for messages.

    Raises:
        ShapeError: It does not.
    """
    if backend == "numba":
        expected, fits = "on the CPU", points.is_cpu
    else:
        from nvsf_core.kernels.encodings.hash_grid_triton import is_interpreted

        expected = "on the CPU, interpreted" if is_interpreted() else "on CUDA"
        fits = points.is_cuda or is_interpreted()
    if not fits or points.dtype != torch.float32 or table.dtype != torch.float32:
        function, asked, stored = what
        raise ShapeError(
            f"{function}: the {backend} backend expects float32 tensors {expected}, found {asked} "
            f"{points.dtype} on {points.device} and {stored} {table.dtype} on {table.device}; "
            "leave the backend out"
        )


def interpolate(points: Tensor, table: Tensor, kernels: Kernels) -> Tensor:
    """Features (n, f) of points (n, d) and a table, with the kernels' gradients."""
    return cast(Tensor, _Interpolate.apply(points, table, kernels))  # type: ignore[no-untyped-call]


class _Interpolate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, points: Tensor, table: Tensor, kernels: Kernels) -> Tensor:
        ctx.save_for_backward(points, table)
        ctx.kernels = kernels
        return kernels.encode(points, table)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        points, table = ctx.saved_tensors
        grad_points = grad_table = None
        if ctx.needs_input_grad[0]:
            grad_points = ctx.kernels.position_adjoint(points, table, grads[0])
        if ctx.needs_input_grad[1]:
            grad_table = ctx.kernels.table_adjoint(points, grads[0])
        return grad_points, grad_table, None


@cache
def _has_triton() -> bool:
    return find_spec("triton") is not None
