"""Bilinear interpolation in a feature plane and its gradients on CUDA, compiled by Triton at first use.

The kernels take planes as (height, width, features), so that a grid point's features are one read; each call
transposes the plane once. Interpreter, rounding and the atomic sum are as in `hash_grid_triton`.
"""

# Triton types its functions by their arguments at launch, and gives annotations a meaning of its own.
# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from nvsf_core.kernels.encodings.hash_grid_triton import add, store_unclamped

_BLOCK = 128
_AXES = tl.constexpr(2)


@triton.jit
def _cell(coordinates, point, inside, cells, AXIS: tl.constexpr):
    """Lower grid point and fraction along an axis; NaN reads grid point 0, and its fraction is NaN."""
    x = tl.load(coordinates + point * _AXES + AXIS, mask=inside, other=0.0)
    known = tl.where(x == x, x, 0.0)
    position = tl.minimum(tl.maximum(known, 0.0), 1.0) * cells
    lower = position.to(tl.int32)
    return lower, tl.where(x == x, position - lower.to(tl.float32), x)


@triton.jit
def _entry(u, v, height, width, CORNER: tl.constexpr):
    """Grid point of a cell's corner; one beyond the border is replaced by the border's (its weight is 0)."""
    column = tl.minimum(u + (CORNER & 1), width - 1)
    row = tl.minimum(v + (CORNER >> 1), height - 1)
    return (row * width + column).to(tl.int64)


@triton.jit(do_not_specialize=["points"])
def _forward(
    coordinates, plane, out, points, height, width, rows, columns,
    FEATURES: tl.constexpr, WIDTH: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    point = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = point < points
    feature = tl.arange(0, WIDTH)[None, :]
    shown = inside[:, None] & (feature < FEATURES)
    u, fu = _cell(coordinates, point, inside, columns, 0)
    v, fv = _cell(coordinates, point, inside, rows, 1)
    total = tl.full((BLOCK, WIDTH), 0.0, tl.float32)
    for corner in tl.static_range(4):
        entry = _entry(u, v, height, width, corner)
        value = tl.load(plane + entry[:, None] * FEATURES + feature, mask=shown, other=0.0)
        weight = (fu if corner & 1 else 1.0 - fu) * (fv if corner >> 1 else 1.0 - fv)
        total += weight[:, None] * value
    tl.store(out + point[:, None] * FEATURES + feature, total, mask=shown)


@triton.jit(do_not_specialize=["points"])
def _plane_adjoint(
    coordinates, grad, grad_plane, points, height, width, rows, columns,
    FEATURES: tl.constexpr, WIDTH: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Add weight * grad of a block of points to the plane's grid points."""
    point = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = point < points
    feature = tl.arange(0, WIDTH)[None, :]
    shown = inside[:, None] & (feature < FEATURES)
    u, fu = _cell(coordinates, point, inside, columns, 0)
    v, fv = _cell(coordinates, point, inside, rows, 1)
    cotangent = tl.load(grad + point[:, None] * FEATURES + feature, mask=shown, other=0.0)
    for corner in tl.static_range(4):
        entry = _entry(u, v, height, width, corner)
        weight = (fu if corner & 1 else 1.0 - fu) * (fv if corner >> 1 else 1.0 - fv)
        target = grad_plane + entry[:, None] * FEATURES + feature
        tl.atomic_add(target, weight[:, None] * cotangent, mask=shown, sem="relaxed")


@triton.jit(do_not_specialize=["points"])
def _coordinate_adjoint(
    coordinates, plane, grad, grad_coordinates, points, height, width, rows, columns,
    FEATURES: tl.constexpr, WIDTH: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Gradient of a block of coordinates: product rule over both weights, times the cells along the axis."""
    point = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = point < points
    feature = tl.arange(0, WIDTH)[None, :]
    shown = inside[:, None] & (feature < FEATURES)
    u, fu = _cell(coordinates, point, inside, columns, 0)
    v, fv = _cell(coordinates, point, inside, rows, 1)
    cotangent = tl.load(grad + point[:, None] * FEATURES + feature, mask=shown, other=0.0)
    grad_u = tl.full((BLOCK,), 0.0, tl.float32)
    grad_v = tl.full((BLOCK,), 0.0, tl.float32)
    for corner in tl.static_range(4):
        entry = _entry(u, v, height, width, corner)
        value = tl.load(plane + entry[:, None] * FEATURES + feature, mask=shown, other=0.0)
        slope = tl.reduce(value * cotangent, 1, add)
        grad_u += (slope if corner & 1 else -slope) * (fv if corner >> 1 else 1.0 - fv)
        grad_v += (slope if corner >> 1 else -slope) * (fu if corner & 1 else 1.0 - fu)
    store_unclamped(coordinates, grad_coordinates, grad_u * columns, point, inside, 0, _AXES)
    store_unclamped(coordinates, grad_coordinates, grad_v * rows, point, inside, 1, _AXES)


def sample(coordinates: Tensor, plane: Tensor) -> Tensor:
    """Interpolate in a float32 plane (features, height, width) at float32 (n, 2), without autograd.

    Arguments and result as in `planes.planes_sample`.
    """
    out = torch.empty(coordinates.shape[0], plane.shape[0], dtype=torch.float32, device=plane.device)
    _launch(_forward, plane.shape, coordinates, _features_last(plane), target=out)
    return out


def adjoint(coordinates: Tensor, grad: Tensor, shape: torch.Size) -> Tensor:
    """Gradient of the plane, a float32 view of its `shape`; its last bits differ between runs.

    From float32 coordinates (n, 2) and the gradient (n, features) float32 of the result.
    """
    features, height, width = shape
    out = torch.zeros(height, width, features, dtype=torch.float32, device=grad.device)
    _launch(_plane_adjoint, shape, coordinates, grad, target=out)
    return out.permute(2, 0, 1)


def coordinate_adjoint(coordinates: Tensor, plane: Tensor, grad: Tensor) -> Tensor:
    """Gradient (n, 2) float32 of the coordinates; 0 along clamped axes.

    From float32 coordinates (n, 2), plane (features, height, width) and gradient (n, features) of the result.
    """
    out = torch.empty_like(coordinates, memory_format=torch.contiguous_format)
    _launch(_coordinate_adjoint, plane.shape, coordinates, _features_last(plane), grad, target=out)
    return out


def _features_last(plane: Tensor) -> Tensor:
    return plane.permute(1, 2, 0)


def _launch(kernel: Any, shape: torch.Size, *sources: Tensor, target: Tensor) -> None:
    """Run a kernel over all points."""
    points = sources[0].shape[0]
    if points == 0:
        return
    features, height, width = shape
    # Triton launches on the current device, which need not be the tensors'.
    with torch.cuda.device_of(target):  # type: ignore[no-untyped-call]
        kernel[(triton.cdiv(points, _BLOCK),)](
            *(source.detach().contiguous() for source in sources),
            target,
            points,
            height,
            width,
            float(height - 1),
            float(width - 1),
            FEATURES=features,
            WIDTH=triton.next_power_of_2(features),
            BLOCK=_BLOCK,
            enable_fp_fusion=False,
        )
