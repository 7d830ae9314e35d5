"""Weighted rows of a table as vector instructions: gather and its adjoint, scatter, for numba kernels.

numba leaves a loop over two or four features scalar, because it cannot prove that the written array is not
the table that is read. Here a row is one vector. Products and sums are single IEEE operations in the order
of the corners, as in the torch oracle: no fused multiply-add.

numba's cache does not watch this file: after a change to it, touch the kernels that call it.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir  # type: ignore[import-untyped,unused-ignore]
from numba.core import types
from numba.extending import intrinsic

__all__ = ["copy_row", "gather", "scatter"]

# Rows are asked for this many points before they are needed; the processor by itself looks some seven ahead.
_AHEAD = 32

_FLOAT = ir.FloatType()
_BYTES = ir.IntType(8).as_pointer()
_INT32 = ir.IntType(32)


def _data(context: Any, builder: Any, signature: Any, args: Any, position: int) -> Any:
    return context.make_array(signature.args[position])(context, builder, args[position]).data


def _row(builder: Any, array: Any, start: Any, width: int) -> Any:
    return builder.bitcast(builder.gep(array, [start]), ir.VectorType(_FLOAT, width).as_pointer())


def _corner(
    builder: Any, table: Any, entry: Any, weight: Any, at: Any, stride: int, width: int
) -> tuple[Any, Any]:
    """Address of the row entry[at] of the table, and weight[at] in every lane."""
    index = builder.zext(builder.load(builder.gep(entry, [at])), ir.IntType(64))
    row = _row(builder, table, builder.mul(index, index.type(stride)), width)
    vector = ir.VectorType(_FLOAT, width)
    nothing = ir.Constant(vector, ir.Undefined)
    lane = builder.insert_element(nothing, builder.load(builder.gep(weight, [at])), _INT32(0))
    first = ir.Constant(ir.VectorType(_INT32, width), [0] * width)
    return row, builder.shuffle_vector(lane, nothing, first)


def _prefetch(
    builder: Any, table: Any, entry: Any, point: Any, corners: int, block: int, stride: int, write: bool
) -> None:
    """Ask for the rows of a point further on, of every other corner: its neighbour in x is mostly beside it.

    Past the last point of a block this asks for a row that nobody needs, which costs next to nothing.
    """
    arguments = [_BYTES, _INT32, _INT32, _INT32]
    prefetch = builder.module.declare_intrinsic(
        "llvm.prefetch", [_BYTES], ir.FunctionType(ir.VoidType(), arguments)
    )
    for corner in range(0, corners, 2):
        at = builder.add(point, point.type(corner * block + _AHEAD))
        index = builder.zext(builder.load(builder.gep(entry, [at])), ir.IntType(64))
        row = builder.bitcast(builder.gep(table, [builder.mul(index, index.type(stride))]), _BYTES)
        builder.call(prefetch, [row, _INT32(int(write)), _INT32(3), _INT32(1)])


@intrinsic(prefer_literal=True)
def copy_row(typing_context, source, first, out, start, width):  # type: ignore[no-untyped-def]
    """``out[start : start + width] = source[first : first + width]``; flat float32, width a constant."""
    signature = types.void(source, types.intp, out, types.intp, width)

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        source_data, out_data = (_data(context, builder, signature, args, position) for position in (0, 2))
        row = builder.load(_row(builder, source_data, args[1], width.literal_value), align=4)
        builder.store(row, _row(builder, out_data, args[3], width.literal_value), align=4)
        return context.get_dummy_value()

    return signature, code


@intrinsic(prefer_literal=True)
def gather(  # type: ignore[no-untyped-def]
    typing_context, table, entry, weight, point, out, start, corners, block, stride, width
):
    """``out[start : start + width] = sum over c of weight[c*block + point] * row(entry[c*block + point])``.

    A row is ``table[e * stride : e * stride + width]``. table, weight, out: flat float32; entry: flat
    uint32, corners * block; point < block, start: whole numbers; the rest: constants of the calling kernel.
    """
    signature = types.void(table, entry, weight, types.intp, out, types.intp, corners, block, stride, width)

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        table_data, entry_data, weight_data, out_data = (
            _data(context, builder, signature, args, position) for position in (0, 1, 2, 4)
        )
        _prefetch(
            builder, table_data, entry_data, args[3], corners.literal_value, block.literal_value,
            stride.literal_value, False,
        )  # fmt: skip
        total = None
        for corner in range(corners.literal_value):
            at = builder.add(args[3], args[3].type(corner * block.literal_value))
            row, spread = _corner(
                builder, table_data, entry_data, weight_data, at, stride.literal_value, width.literal_value
            )
            term = builder.fmul(spread, builder.load(row, align=4))
            total = term if total is None else builder.fadd(total, term)
        builder.store(total, _row(builder, out_data, args[5], width.literal_value), align=4)
        return context.get_dummy_value()

    return signature, code


@intrinsic(prefer_literal=True)
def scatter(  # type: ignore[no-untyped-def]
    typing_context, table, entry, weight, point, grad, start, corners, block, stride, width
):
    """``row(entry[c*block + point]) += weight[c*block + point] * grad[start : start + width]``, c in order.

    The adjoint of `gather`, with the same arguments; adds to the table.
    """
    signature = types.void(table, entry, weight, types.intp, grad, types.intp, corners, block, stride, width)

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        table_data, entry_data, weight_data, grad_data = (
            _data(context, builder, signature, args, position) for position in (0, 1, 2, 4)
        )
        _prefetch(
            builder, table_data, entry_data, args[3], corners.literal_value, block.literal_value,
            stride.literal_value, True,
        )  # fmt: skip
        cotangent = builder.load(_row(builder, grad_data, args[5], width.literal_value), align=4)
        for corner in range(corners.literal_value):
            at = builder.add(args[3], args[3].type(corner * block.literal_value))
            row, spread = _corner(
                builder, table_data, entry_data, weight_data, at, stride.literal_value, width.literal_value
            )
            old = builder.load(row, align=4)
            builder.store(builder.fadd(old, builder.fmul(spread, cotangent)), row, align=4)
        return context.get_dummy_value()

    return signature, code
