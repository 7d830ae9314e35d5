"""The hash-grid encoding and its gradients on CUDA, compiled by Triton at first use.

Triton brings its own compiler. Numbers of points are not specialised: each kernel would be compiled again for
those that 16 divides. With the environment variable TRITON_INTERPRET=1, set before this module is imported,
the same kernels run on CPU tensors (slowly, for tests).

Every launch switches fused multiply-add off. So positions in grid units are rounded after the product and
after the sum, as in the torch oracle, and the forward pass is bit-identical to it; fused, weights would
differ in their last bits, and at a cell border the cell could differ.

The gradient of the table is summed atomically, in any order, so its last bits differ from run to run;
everything else is bit-identical in every run.
"""

# Triton types its functions by their arguments at launch, and gives annotations a meaning of its own.
# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

from functools import cache
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from nvsf_core.kernels.encodings.hash_grid import PRIMES, GridLayout

_PRIME_Y = tl.constexpr(PRIMES[1])
_PRIME_Z = tl.constexpr(PRIMES[2])
# Points of a program. The programs are along the launch grid's first axis, which allows 2^31 of them: one
# launch is enough for all points that fit into memory.
_BLOCK = 128


@triton.jit
def _cell(positions, point, inside, scale, AXIS: tl.constexpr, DIMENSIONS: tl.constexpr):
    """Lower grid point and fraction along an axis; NaN reads cell 0, and its fraction is NaN."""
    x = tl.load(positions + point * DIMENSIONS + AXIS, mask=inside, other=0.0)
    known = tl.where(x == x, x, 0.0)
    position = tl.minimum(tl.maximum(known, 0.0), 1.0) * scale + 0.5
    lower = position.to(tl.int32)
    return lower, tl.where(x == x, position - lower.to(tl.float32), x)


@triton.jit
def _cells(positions, point, inside, scale, DIMENSIONS: tl.constexpr):
    """`_cell` along x, y and z; in two dimensions z is a copy of y that is not used."""
    x, fx = _cell(positions, point, inside, scale, 0, DIMENSIONS)
    y, fy = _cell(positions, point, inside, scale, 1, DIMENSIONS)
    z, fz = y, fy
    if DIMENSIONS == 3:
        z, fz = _cell(positions, point, inside, scale, 2, DIMENSIONS)
    return x, y, z, fx, fy, fz


@triton.jit
def _entry(
    x, y, z, resolution, dense, offset, entry_mask, CORNER: tl.constexpr, DIMENSIONS: tl.constexpr
):  # fmt: skip
    """Table row of a cell's corner: x varies fastest in dense levels, others are hashed."""
    top = resolution - 1
    cx = x + (CORNER & 1)
    cy = y + ((CORNER >> 1) & 1)
    row = tl.minimum(cx, top) + resolution * tl.minimum(cy, top)
    hashed = cx.to(tl.uint32) ^ (cy.to(tl.uint32) * _PRIME_Y)
    if DIMENSIONS == 3:
        cz = z + (CORNER >> 2)
        row += resolution * resolution * tl.minimum(cz, top)
        hashed = hashed ^ (cz.to(tl.uint32) * _PRIME_Z)
    row = tl.where(dense != 0, row, (hashed & entry_mask).to(tl.int32))
    return offset + row.to(tl.int64)


@triton.jit
def _weight(fx, fy, fz, CORNER: tl.constexpr, DIMENSIONS: tl.constexpr):
    """Weight of a corner, its factors multiplied in the oracle's order."""
    weight = (fx if CORNER & 1 else 1.0 - fx) * (fy if (CORNER >> 1) & 1 else 1.0 - fy)
    if DIMENSIONS == 3:
        weight = weight * (fz if CORNER >> 2 else 1.0 - fz)
    return weight


@triton.jit(do_not_specialize=["points"])
def _forward(
    positions, table, out, points, scales, resolutions, dense, offsets, entry_mask,
    LEVELS: tl.constexpr, DIMENSIONS: tl.constexpr, FEATURES: tl.constexpr, WIDTH: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Encode a block of points in one level; levels are the launch grid's last axis, for the cache's sake."""
    level = tl.program_id(1)
    scale, resolution = tl.load(scales + level), tl.load(resolutions + level)
    is_dense, offset = tl.load(dense + level), tl.load(offsets + level)
    point = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = point < points
    feature = tl.arange(0, WIDTH)[None, :]
    shown = inside[:, None] & (feature < FEATURES)
    x, y, z, fx, fy, fz = _cells(positions, point, inside, scale, DIMENSIONS)
    total = tl.full((BLOCK, WIDTH), 0.0, tl.float32)
    for corner in tl.static_range(1 << DIMENSIONS):
        entry = _entry(x, y, z, resolution, is_dense, offset, entry_mask, corner, DIMENSIONS)
        value = tl.load(table + entry[:, None] * FEATURES + feature, mask=shown, other=0.0)
        total += _weight(fx, fy, fz, corner, DIMENSIONS)[:, None] * value
    tl.store(out + (point * LEVELS + level)[:, None] * FEATURES + feature, total, mask=shown)


@triton.jit(do_not_specialize=["points"])
def _table_adjoint(
    positions, grad, grad_table, points, scales, resolutions, dense, offsets, entry_mask,
    LEVELS: tl.constexpr, DIMENSIONS: tl.constexpr, FEATURES: tl.constexpr, WIDTH: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Add weight * grad of a block of points to one level's entries."""
    level = tl.program_id(1)
    scale, resolution = tl.load(scales + level), tl.load(resolutions + level)
    is_dense, offset = tl.load(dense + level), tl.load(offsets + level)
    point = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = point < points
    feature = tl.arange(0, WIDTH)[None, :]
    shown = inside[:, None] & (feature < FEATURES)
    x, y, z, fx, fy, fz = _cells(positions, point, inside, scale, DIMENSIONS)
    cotangent = tl.load(
        grad + (point * LEVELS + level)[:, None] * FEATURES + feature, mask=shown, other=0.0
    )  # fmt: skip
    for corner in tl.static_range(1 << DIMENSIONS):
        entry = _entry(x, y, z, resolution, is_dense, offset, entry_mask, corner, DIMENSIONS)
        share = _weight(fx, fy, fz, corner, DIMENSIONS)[:, None] * cotangent
        tl.atomic_add(grad_table + entry[:, None] * FEATURES + feature, share, mask=shown, sem="relaxed")


@triton.jit(do_not_specialize=["points"])
def _position_adjoint(
    positions, table, grad, grad_positions, points, scales, resolutions, dense, offsets, entry_mask,
    LEVELS: tl.constexpr, DIMENSIONS: tl.constexpr, FEATURES: tl.constexpr, WIDTH: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Gradient of a block of positions, over all levels: product rule over the axes' weights, times scale."""
    point = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = point < points
    feature = tl.arange(0, WIDTH)[None, :]
    shown = inside[:, None] & (feature < FEATURES)
    grad_x = tl.full((BLOCK,), 0.0, tl.float32)
    grad_y = tl.full((BLOCK,), 0.0, tl.float32)
    grad_z = tl.full((BLOCK,), 0.0, tl.float32)
    for level in range(LEVELS):
        scale, resolution = tl.load(scales + level), tl.load(resolutions + level)
        is_dense, offset = tl.load(dense + level), tl.load(offsets + level)
        x, y, z, fx, fy, fz = _cells(positions, point, inside, scale, DIMENSIONS)
        cotangent = tl.load(
            grad + (point * LEVELS + level)[:, None] * FEATURES + feature, mask=shown, other=0.0
        )  # fmt: skip
        for corner in tl.static_range(1 << DIMENSIONS):
            entry = _entry(x, y, z, resolution, is_dense, offset, entry_mask, corner, DIMENSIONS)
            value = tl.load(table + entry[:, None] * FEATURES + feature, mask=shown, other=0.0)
            slope = scale * tl.reduce(value * cotangent, 1, add)
            wx = fx if corner & 1 else 1.0 - fx
            wy = fy if (corner >> 1) & 1 else 1.0 - fy
            if DIMENSIONS == 3:
                wz = fz if corner >> 2 else 1.0 - fz
                grad_z += (slope if corner >> 2 else -slope) * wx * wy
                slope *= wz
            grad_x += (slope if corner & 1 else -slope) * wy
            grad_y += (slope if (corner >> 1) & 1 else -slope) * wx
    store_unclamped(positions, grad_positions, grad_x, point, inside, 0, DIMENSIONS)
    store_unclamped(positions, grad_positions, grad_y, point, inside, 1, DIMENSIONS)
    if DIMENSIONS == 3:
        store_unclamped(positions, grad_positions, grad_z, point, inside, 2, DIMENSIONS)


@triton.jit
def add(a, b):
    """The sum of two values, for `tl.reduce`."""
    return a + b


@triton.jit
def store_unclamped(
    positions, grad_positions, grad, point, inside, AXIS: tl.constexpr, DIMENSIONS: tl.constexpr
):  # fmt: skip
    """Store a gradient along one axis; 0 where the position is clamped along it or NaN.

    Args:
        positions: Pointer to float32 (n, DIMENSIONS).
        grad_positions: Pointer of the same shape, written.
        grad: (BLOCK,) gradient along the axis.
        point: (BLOCK,) indices of points.
        inside: (BLOCK,) bool, whether the point exists.
        AXIS: Number of the axis.
        DIMENSIONS: Number of axes.
    """
    x = tl.load(positions + point * DIMENSIONS + AXIS, mask=inside, other=0.0)
    free = (x >= 0.0) & (x <= 1.0)
    tl.store(grad_positions + point * DIMENSIONS + AXIS, tl.where(free, grad, 0.0), mask=inside)


def is_interpreted() -> bool:
    """Whether Triton's interpreter runs these kernels, on the CPU, instead of a CUDA device."""
    return not isinstance(_forward, triton.JITFunction)


def encode(positions: Tensor, table: Tensor, layout: GridLayout) -> Tensor:
    """Encode float32 positions (n, dimensions) with a float32 table, without autograd.

    Arguments and result as in `hash_grid.hash_grid_encode`.
    """
    out = torch.empty(positions.shape[0], layout.outputs, dtype=torch.float32, device=positions.device)
    _launch(_forward, layout, layout.levels, positions, table, target=out)
    return out


def adjoint(positions: Tensor, grad: Tensor, layout: GridLayout) -> Tensor:
    """Gradient (layout.entries, layout.features) float32 of the table; its last bits differ between runs.

    From float32 positions (n, dimensions) and the gradient (n, levels * features) float32 of the encoding.
    """
    out = torch.zeros(layout.entries, layout.features, dtype=torch.float32, device=positions.device)
    _launch(_table_adjoint, layout, layout.levels, positions, grad, target=out)
    return out


def position_adjoint(positions: Tensor, table: Tensor, grad: Tensor, layout: GridLayout) -> Tensor:
    """Gradient (n, dimensions) float32 of the positions; 0 along clamped axes.

    From float32 positions (n, dimensions), table (layout.entries, layout.features) and gradient (n, levels *
    features) of the encoding.
    """
    out = torch.empty_like(positions, memory_format=torch.contiguous_format)
    _launch(_position_adjoint, layout, 1, positions, table, grad, target=out)
    return out


def _launch(kernel: Any, layout: GridLayout, parts: int, *sources: Tensor, target: Tensor) -> None:
    """Run a kernel over all points; the second axis of the launch grid has `parts` programs."""
    points = sources[0].shape[0]
    if points == 0:
        return
    # Triton launches on the current device, which need not be the tensors'.
    with torch.cuda.device_of(target):  # type: ignore[no-untyped-call]
        kernel[(triton.cdiv(points, _BLOCK), parts)](
            *(source.detach().contiguous() for source in sources),
            target,
            points,
            *_level_tensors(layout, target.device),
            layout.table_entries - 1,
            LEVELS=layout.levels,
            DIMENSIONS=layout.dimensions,
            FEATURES=layout.features,
            WIDTH=triton.next_power_of_2(layout.features),
            BLOCK=_BLOCK,
            enable_fp_fusion=False,
        )


@cache
def _level_tensors(layout: GridLayout, device: torch.device) -> tuple[Tensor, ...]:
    return (
        torch.tensor(layout.scales, dtype=torch.float32, device=device),
        torch.tensor(layout.resolutions, dtype=torch.int32, device=device),
        torch.tensor(layout.is_dense, dtype=torch.int32, device=device),
        torch.tensor(layout.offsets, dtype=torch.int64, device=device),
    )
