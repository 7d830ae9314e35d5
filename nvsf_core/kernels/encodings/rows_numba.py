"""Weighted sums of a table's rows (gather) and their adjoint (scatter) as vector instructions, for numba.

numba does not vectorise a loop over two or four features, because it cannot prove that the written array is
not the table that is read. Here the two rows of neighbours in x are one vector, which halves the number of
loads and sums. Products and sums are single IEEE operations, without fused multiply-add. A gather adds all
lower rows and all upper rows, then both; the torch oracle has another order.
"""

from collections.abc import Iterable, Iterator
from typing import Any

from llvmlite import ir  # type: ignore[import-untyped,unused-ignore]
from numba.core import types
from numba.extending import intrinsic

from nvsf_core.kernels.encodings.corners_numba import AHEAD

_FLOAT = ir.FloatType()
_BYTES = ir.IntType(8).as_pointer()
_INT32, _INT64 = ir.IntType(32), ir.IntType(64)


def _data(context: Any, builder: Any, signature: Any, args: Any, position: int) -> Any:
    return context.make_array(signature.args[position])(context, builder, args[position]).data


def _row(builder: Any, array: Any, start: Any, width: int) -> Any:
    return builder.bitcast(builder.gep(array, [start]), ir.VectorType(_FLOAT, width).as_pointer())


def _pair_start(builder: Any, point: Any, corner: int, block: int) -> Any:
    """Index of a point's pair of corners `corner` and `corner + 1` in the arrays of `place_corners`."""
    return builder.add(builder.shl(point, point.type(1)), point.type(corner * block))


def _pair_rows(builder: Any, table: Any, entry: Any, at: Any, stride: int, width: int) -> tuple[Any, Any]:
    """Addresses of the rows entry[at] and entry[at + 1] of the table, from one load."""
    both = builder.load(builder.bitcast(builder.gep(entry, [at]), _INT64.as_pointer()), align=4)
    lower, upper = builder.and_(both, _INT64(0xFFFFFFFF)), builder.lshr(both, _INT64(32))
    return (
        _row(builder, table, builder.mul(lower, _INT64(stride)), width),
        _row(builder, table, builder.mul(upper, _INT64(stride)), width),
    )


def _shuffled(builder: Any, first: Any, second: Any, lanes: Iterable[int]) -> Any:
    numbers = list(lanes)
    return builder.shuffle_vector(first, second, ir.Constant(ir.VectorType(_INT32, len(numbers)), numbers))


def _pair_weights(builder: Any, weight: Any, at: Any, width: int) -> Any:
    """A vector of `width` times weight[at], then `width` times weight[at + 1]."""
    pair = builder.load(_row(builder, weight, at, 2), align=4)
    return _shuffled(builder, pair, pair, [0] * width + [1] * width)


def _prefetch(
    builder: Any, table: Any, entry: Any, point: Any, corners: int, block: int, stride: int, write: bool
) -> None:
    """Prefetch rows of the point AHEAD, of every other corner: its neighbour in x is mostly adjacent.

    Near the end of a block this fetches rows that are not needed, at almost no cost.
    """
    arguments = [_BYTES, _INT32, _INT32, _INT32]
    prefetch = builder.module.declare_intrinsic(
        "llvm.prefetch", [_BYTES], ir.FunctionType(ir.VoidType(), arguments)
    )
    for corner in range(0, corners, 2):
        at = _pair_start(builder, builder.add(point, point.type(AHEAD)), corner, block)
        index = builder.zext(builder.load(builder.gep(entry, [at])), ir.IntType(64))
        row = builder.bitcast(builder.gep(table, [builder.mul(index, index.type(stride))]), _BYTES)
        builder.call(prefetch, [row, _INT32(int(write)), _INT32(3), _INT32(1)])


def _pairs(
    context: Any, builder: Any, signature: Any, args: Any, *, write: bool
) -> Iterator[tuple[Any, Any]]:
    """Of each pair of a point's corners: the addresses of both rows of the table, and their weights."""
    table, entry, weight = (_data(context, builder, signature, args, position) for position in range(3))
    corners, block, stride, width = (one.literal_value for one in signature.args[6:])
    _prefetch(builder, table, entry, args[3], corners, block, stride, write)
    for corner in range(0, corners, 2):
        at = _pair_start(builder, args[3], corner, block)
        addresses = _pair_rows(builder, table, entry, at, stride, width)
        yield addresses, _pair_weights(builder, weight, at, width)


@intrinsic(prefer_literal=True)
def copy_row(typing_context, source, first, out, start, width):  # type: ignore[no-untyped-def]
    """``out[start : start + width] = source[first : first + width]``.

    Args:
        typing_context: numba's.
        source: Flat float32.
        first: Index.
        out: Flat float32, written.
        start: Index.
        width: Constant of the calling kernel.
    """
    signature = types.void(source, types.intp, out, types.intp, width)

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        source_data, out_data = (_data(context, builder, signature, args, position) for position in (0, 2))
        row = builder.load(_row(builder, source_data, args[1], width.literal_value), align=4)
        builder.store(row, _row(builder, out_data, args[3], width.literal_value), align=4)
        return context.get_dummy_value()

    return signature, code


# Wide: an intrinsic takes flat arrays, indices into them, and constants.
@intrinsic(prefer_literal=True)
def gather(  # type: ignore[no-untyped-def]
    typing_context, table, entry, weight, point, out, start, corners, block, stride, width
):
    """``out[start : start + width] = sum over corners of weight * table[e * stride : e * stride + width]``.

    Args:
        typing_context: numba's.
        table: Flat float32.
        entry: Row numbers e from `place_corners`.
        weight: Weights from `place_corners`.
        point: Index of the point in its block.
        out: Flat float32, written.
        start: Index.
        corners: Number of corners, like the following a constant of the calling kernel.
        block: Points a block.
        stride: Length of a row.
        width: Features that are read from a row.
    """
    signature = types.void(table, entry, weight, types.intp, out, types.intp, corners, block, stride, width)

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        total, wide = None, width.literal_value
        for addresses, weights in _pairs(context, builder, signature, args, write=False):
            lower, upper = (builder.load(address, align=4) for address in addresses)
            term = builder.fmul(weights, _shuffled(builder, lower, upper, range(2 * wide)))
            total = term if total is None else builder.fadd(total, term)
        lower, upper = (_shuffled(builder, total, total, range(k, k + wide)) for k in (0, wide))
        target = _row(builder, _data(context, builder, signature, args, 4), args[5], wide)
        builder.store(builder.fadd(lower, upper), target, align=4)
        return context.get_dummy_value()

    return signature, code


# Wide: an intrinsic takes flat arrays, indices into them, and constants.
@intrinsic(prefer_literal=True)
def scatter(  # type: ignore[no-untyped-def]
    typing_context, table, entry, weight, point, grad, start, corners, block, stride, width
):
    """``table[e * stride : e * stride + width] += weight * grad[start : start + width]``, corner by corner.

    The adjoint of `gather`.

    Args:
        typing_context: numba's.
        table: Flat float32, added to.
        entry: Row numbers e from `place_corners`.
        weight: Weights from `place_corners`.
        point: Index of the point in its block.
        grad: Flat float32.
        start: Index.
        corners: Number of corners, like the following a constant of the calling kernel.
        block: Points a block.
        stride: Length of a row.
        width: Features that are written to a row.
    """
    signature = types.void(table, entry, weight, types.intp, grad, types.intp, corners, block, stride, width)

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        wide = width.literal_value
        grad_data = _data(context, builder, signature, args, 4)
        once = builder.load(_row(builder, grad_data, args[5], wide), align=4)
        twice = _shuffled(builder, once, once, range(2 * wide))
        for addresses, weights in _pairs(context, builder, signature, args, write=True):
            terms = builder.fmul(weights, twice)
            # One after the other, because at the last grid point both are the same row.
            for address, k in zip(addresses, (0, wide), strict=True):
                term = _shuffled(builder, terms, terms, range(k, k + wide))
                builder.store(builder.fadd(builder.load(address, align=4), term), address, align=4)
        return context.get_dummy_value()

    return signature, code
