"""The hash-grid encode: one interface, the kernel chosen by where the tensors are."""

from __future__ import annotations

from typing import Any, Literal, cast

import torch
from torch import Tensor

from nvsf_core.errors import ShapeError
from nvsf_core.kernels import hash_grid_torch
from nvsf_core.kernels.layout import GridLayout

__all__ = ["Backend", "hash_grid_encode"]

Backend = Literal["torch", "numba"]


def hash_grid_encode(
    positions: Tensor, table: Tensor, layout: GridLayout, backend: Backend | None = None
) -> Tensor:
    """Linear look-up of every level of a multiresolution hash grid.

    ``out[:, l*F:(l+1)*F] = sum over the grid points c around x of w_c(x) * table[offset_l + index_l(c)]``,
    8 points c in three dimensions, 4 in two. Positions outside the box are clamped to it: they get the
    encoding of the nearest point of the box, and no gradient along the clamped axes. In a dense level a grid
    point past the last is the last one. A NaN position yields a NaN encoding. float32 on the CPU runs in
    numba; anything else in the torch oracle.

    Args:
        positions: (n, layout.dimensions) in [0, 1], floating; they may require a gradient (the oracle
            computes that one).
        table: (layout.entries, layout.features), floating, on the same device.
        layout: the grid.
        backend: "torch" or "numba" to override the choice.

    Returns:
        (n, levels * features), level by level, of the table's type.

    Raises:
        ShapeError: a shape, type or device does not fit the layout or the backend.
    """
    _require_shapes(positions, table, layout)
    numba_can = _is_cpu_float32(positions) and _is_cpu_float32(table)
    if backend is None:
        backend = "numba" if numba_can else "torch"
    if backend == "torch":
        return hash_grid_torch.encode(positions, table, layout)
    if not numba_can:
        raise ShapeError(
            "hash_grid_encode: the numba backend expects float32 tensors on the CPU, found positions "
            f"{positions.dtype} on {positions.device} and table {table.dtype} on {table.device}; "
            "leave the backend out"
        )
    return cast(Tensor, _NumbaEncode.apply(positions, table, layout))  # type: ignore[no-untyped-call]


class _NumbaEncode(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, positions: Tensor, table: Tensor, layout: GridLayout) -> Tensor:
        # numba costs 0.3 s to import and nothing but this path needs it
        from nvsf_core.kernels import hash_grid_numba

        ctx.save_for_backward(positions, table)
        ctx.layout = layout
        return hash_grid_numba.encode(positions, table, layout)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        from nvsf_core.kernels import hash_grid_numba

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


def _is_cpu_float32(tensor: Tensor) -> bool:
    return tensor.device.type == "cpu" and tensor.dtype == torch.float32


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
