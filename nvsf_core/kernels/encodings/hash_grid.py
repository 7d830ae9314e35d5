"""The hash-grid encoding: one function, which chooses the kernel by the tensors' device and type."""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec
from typing import Any, Literal, cast

import torch
from torch import Tensor

from nvsf_core.errors import ShapeError
from nvsf_core.kernels.encodings import hash_grid_torch
from nvsf_core.kernels.encodings.layout import GridLayout

__all__ = ["Backend", "hash_grid_encode"]

Backend = Literal["torch", "numba", "triton"]


def hash_grid_encode(
    positions: Tensor, table: Tensor, layout: GridLayout, backend: Backend | None = None
) -> Tensor:
    """Features of positions, interpolated linearly in every level of a multiresolution hash grid.

    ``out[:, l*F:(l+1)*F] = sum over the grid points c around x of w_c(x) * table[offset_l + index_l(c)]``,
    8 points c in three dimensions, 4 in two. Positions outside the box are clamped to it and have no gradient
    along the clamped axes. In a dense level a grid point past the last is replaced by the last. A NaN
    position has a NaN encoding. float32 is computed by numba on the CPU and by Triton on CUDA (if Triton is
    installed), everything else by the torch oracle.

    Args:
        positions: (n, layout.dimensions) in [0, 1], floating; may require a gradient (which the oracle
            computes for numba).
        table: (layout.entries, layout.features), floating, on the same device.
        layout: Sizes of the grid.
        backend: Overrides the choice; "triton" takes CPU tensors only under Triton's interpreter.

    Returns:
        (n, levels * features), level by level, of the table's type.

    Raises:
        ShapeError: A shape, type or device does not fit the layout or the backend.
    """
    _require_shapes(positions, table, layout)
    backend = backend or _backend_for(positions, table)
    if backend == "torch":
        return hash_grid_torch.encode(positions, table, layout)
    _require_backend(backend, positions, table)
    kernel = _NumbaEncode if backend == "numba" else _TritonEncode
    return cast(Tensor, kernel.apply(positions, table, layout))  # type: ignore[no-untyped-call]


class _NumbaEncode(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, positions: Tensor, table: Tensor, layout: GridLayout) -> Tensor:
        # Importing numba takes 0.3 s, and only this path needs it.
        from nvsf_core.kernels.encodings import hash_grid_numba

        ctx.save_for_backward(positions, table)
        ctx.layout = layout
        return hash_grid_numba.encode(positions, table, layout)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        from nvsf_core.kernels.encodings import hash_grid_numba

        positions, table = ctx.saved_tensors
        grad_positions = grad_table = None
        if ctx.needs_input_grad[0]:
            with torch.enable_grad():
                moved = positions.detach().requires_grad_()
                encoded = hash_grid_torch.encode(moved, table.detach(), ctx.layout)
                (grad_positions,) = torch.autograd.grad(encoded, moved, grads[0])
        if ctx.needs_input_grad[1]:
            grad_table = hash_grid_numba.adjoint(positions, grads[0], ctx.layout)
        return grad_positions, grad_table, None


class _TritonEncode(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, positions: Tensor, table: Tensor, layout: GridLayout) -> Tensor:
        # Not every machine has Triton.
        from nvsf_core.kernels.encodings import hash_grid_triton

        ctx.save_for_backward(positions, table)
        ctx.layout = layout
        return hash_grid_triton.encode(positions, table, layout)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        from nvsf_core.kernels.encodings import hash_grid_triton

        positions, table = ctx.saved_tensors
        grad_positions = grad_table = None
        if ctx.needs_input_grad[0]:
            grad_positions = hash_grid_triton.position_adjoint(positions, table, grads[0], ctx.layout)
        if ctx.needs_input_grad[1]:
            grad_table = hash_grid_triton.adjoint(positions, grads[0], ctx.layout)
        return grad_positions, grad_table, None


def _backend_for(positions: Tensor, table: Tensor) -> Backend:
    if positions.dtype != torch.float32 or table.dtype != torch.float32:
        return "torch"
    if positions.is_cpu:
        return "numba"
    return "triton" if positions.is_cuda and _has_triton() else "torch"


@cache
def _has_triton() -> bool:
    return find_spec("triton") is not None


def _require_backend(backend: Backend, positions: Tensor, table: Tensor) -> None:
    if backend == "numba":
        expected, fits = "on the CPU", positions.is_cpu
    else:
        from nvsf_core.kernels.encodings import hash_grid_triton

        expected = "on the CPU, interpreted" if hash_grid_triton.is_interpreted() else "on CUDA"
        fits = positions.is_cuda or hash_grid_triton.is_interpreted()
    if not fits or positions.dtype != torch.float32 or table.dtype != torch.float32:
        raise ShapeError(
            f"hash_grid_encode: the {backend} backend expects float32 tensors {expected}, found positions "
            f"{positions.dtype} on {positions.device} and table {table.dtype} on {table.device}; "
            "leave the backend out"
        )


def _require_shapes(positions: Tensor, table: Tensor, layout: GridLayout) -> None:
    if positions.ndim != 2 or positions.shape[1] != layout.dimensions:
        raise ShapeError(
            f"hash_grid_encode: expected positions (n, {layout.dimensions}) for {layout}, found "
            f"{tuple(positions.shape)}"
        )
    expected = (layout.entries, layout.features)
    if tuple(table.shape) != expected:
        raise ShapeError(
            f"hash_grid_encode: expected a table {expected} for {layout}, found {tuple(table.shape)}; "
            "make it with this layout"
        )
    if positions.device != table.device:
        raise ShapeError(
            f"hash_grid_encode: expected one device, found positions on {positions.device} and the table "
            f"on {table.device}; move one"
        )
