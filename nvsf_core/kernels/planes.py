"""Bilinear samples of a feature plane: one interface, the kernel chosen by where the tensors are."""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec
from typing import Any, Literal, cast

import torch
from torch import Tensor

from nvsf_core.errors import ShapeError
from nvsf_core.kernels import planes_torch

__all__ = ["PlanesBackend", "planes_sample"]

PlanesBackend = Literal["torch", "triton"]


def planes_sample(coordinates: Tensor, plane: Tensor, backend: PlanesBackend | None = None) -> Tensor:
    """Bilinear look-up in a plane of features whose outermost grid points lie on the square's border.

    ``out[i] = sum over the 4 grid points c around x_i of w_c(x_i) * plane[:, row_c, column_c]``, with x_i
    at ``column = x * (width - 1)``, ``row = y * (height - 1)``. Coordinates outside the square are clamped
    to it and get no gradient along the clamped axes; a NaN coordinate yields a NaN sample. Where the cell
    ends beyond the last grid point (at 1, or along an axis of one grid point) the value does not change
    along that axis: its gradient there is 0. float32 on CUDA runs in Triton (where it is installed);
    anything else in the torch oracle.

    Args:
        coordinates: (n, 2) in [0, 1], floating: first along the width, second along the height.
        plane: (features, height, width), floating, on the same device.
        backend: overrides the choice. "triton" takes CPU tensors only under Triton's interpreter.

    Returns:
        (n, features), of the plane's type.

    Raises:
        ShapeError: a shape, type or device does not fit.
    """
    _require_shapes(coordinates, plane)
    if backend is None:
        on_cuda = coordinates.is_cuda and _are_float32(coordinates, plane)
        backend = "triton" if on_cuda and _has_triton() else "torch"
    if backend == "torch":
        return planes_torch.sample(coordinates, plane)
    _require_triton_can(coordinates, plane)
    return cast(Tensor, _TritonSample.apply(coordinates, plane))  # type: ignore[no-untyped-call]


class _TritonSample(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, coordinates: Tensor, plane: Tensor) -> Tensor:
        # not every machine has Triton
        from nvsf_core.kernels import planes_triton

        ctx.save_for_backward(coordinates, plane)
        return planes_triton.sample(coordinates, plane)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, Tensor | None]:
        from nvsf_core.kernels import planes_triton

        coordinates, plane = ctx.saved_tensors
        grad_coordinates = grad_plane = None
        if ctx.needs_input_grad[0]:
            grad_coordinates = planes_triton.coordinate_adjoint(coordinates, plane, grads[0])
        if ctx.needs_input_grad[1]:
            grad_plane = planes_triton.adjoint(coordinates, grads[0], plane.shape)
        return grad_coordinates, grad_plane


@cache
def _has_triton() -> bool:
    return find_spec("triton") is not None


def _are_float32(coordinates: Tensor, plane: Tensor) -> bool:
    return coordinates.dtype == torch.float32 and plane.dtype == torch.float32


def _require_triton_can(coordinates: Tensor, plane: Tensor) -> None:
    from nvsf_core.kernels import planes_triton

    interpreted = planes_triton.is_interpreted()
    if not _are_float32(coordinates, plane) or not (coordinates.is_cuda or interpreted):
        raise ShapeError(
            "planes_sample: the triton backend expects float32 tensors on "
            f"{'the CPU, interpreted' if interpreted else 'CUDA'}, found coordinates {coordinates.dtype} on "
            f"{coordinates.device} and a plane {plane.dtype} on {plane.device}; leave the backend out"
        )


def _require_shapes(coordinates: Tensor, plane: Tensor) -> None:
    if coordinates.ndim != 2 or coordinates.shape[1] != 2:
        raise ShapeError(
            f"planes_sample: expected coordinates (n, 2), found {tuple(coordinates.shape)}; "
            "select the plane's two axes"
        )
    if plane.ndim != 3 or 0 in plane.shape:
        raise ShapeError(
            "planes_sample: expected a plane (features, height, width) with at least one grid point, found "
            f"{tuple(plane.shape)}; make it so"
        )
    if coordinates.device != plane.device:
        raise ShapeError(
            f"planes_sample: expected one device, found coordinates on {coordinates.device} and the plane on "
            f"{plane.device}; move one"
        )
