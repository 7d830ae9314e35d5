"""Bilinear interpolation in feature planes: one function, which chooses the kernel by device and type."""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec
from typing import Any, Literal, cast

import torch
from torch import Tensor

from nvsf_core.errors import ShapeError
from nvsf_core.kernels.encodings import planes_torch

__all__ = ["PlanesBackend", "planes_sample"]

PlanesBackend = Literal["torch", "numba", "triton"]


def planes_sample(coordinates: Tensor, plane: Tensor, backend: PlanesBackend | None = None) -> Tensor:
    """Features of points in the unit square, interpolated bilinearly; the plane's border is the square's.

    ``out[i] = sum over the 4 grid points c around x_i of w_c(x_i) * plane[:, row_c, column_c]``, with x_i
    at ``column = x * (width - 1)``, ``row = y * (height - 1)``. Coordinates outside the square are clamped
    to it and have no gradient along the clamped axes; a NaN coordinate has a NaN result. At the coordinate 1,
    and along an axis of one grid point, the gradient along that axis is 0. float32 is computed by numba on
    the CPU and by Triton on CUDA (if Triton is installed), everything else by the torch oracle.

    Args:
        coordinates: (n, 2) in [0, 1], floating, along the width and the height; may require a gradient.
        plane: (features, height, width), floating, on the same device.
        backend: Overrides the choice; "triton" takes CPU tensors only under Triton's interpreter.

    Returns:
        (n, features), of the plane's type.

    Raises:
        ShapeError: A shape, type or device does not fit.
    """
    _require_shapes(coordinates, plane)
    backend = backend or _backend_for(coordinates, plane)
    if backend == "torch":
        return planes_torch.sample(coordinates, plane)
    _require_backend(backend, coordinates, plane)
    kernel = _NumbaSample if backend == "numba" else _TritonSample
    return cast(Tensor, kernel.apply(coordinates, plane))  # type: ignore[no-untyped-call]


class _NumbaSample(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, coordinates: Tensor, plane: Tensor) -> Tensor:
        # Importing numba takes 0.3 s, and only this path needs it.
        from nvsf_core.kernels.encodings import planes_numba

        ctx.save_for_backward(coordinates, plane)
        return planes_numba.sample(coordinates, plane)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, Tensor | None]:
        from nvsf_core.kernels.encodings import planes_numba, planes_slope_numba

        coordinates, plane = ctx.saved_tensors
        grad_coordinates = grad_plane = None
        if ctx.needs_input_grad[0]:
            grad_coordinates = planes_slope_numba.coordinate_adjoint(coordinates, plane, grads[0])
        if ctx.needs_input_grad[1]:
            grad_plane = planes_numba.adjoint(coordinates, grads[0], plane.shape)
        return grad_coordinates, grad_plane


class _TritonSample(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, coordinates: Tensor, plane: Tensor) -> Tensor:
        # Not every machine has Triton.
        from nvsf_core.kernels.encodings import planes_triton

        ctx.save_for_backward(coordinates, plane)
        return planes_triton.sample(coordinates, plane)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, Tensor | None]:
        from nvsf_core.kernels.encodings import planes_triton

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


def _backend_for(coordinates: Tensor, plane: Tensor) -> PlanesBackend:
    if coordinates.dtype != torch.float32 or plane.dtype != torch.float32:
        return "torch"
    if coordinates.is_cpu:
        return "numba"
    return "triton" if coordinates.is_cuda and _has_triton() else "torch"


def _require_backend(backend: PlanesBackend, coordinates: Tensor, plane: Tensor) -> None:
    if backend == "numba":
        expected, fits = "on the CPU", coordinates.is_cpu
    else:
        from nvsf_core.kernels.encodings import planes_triton

        expected = "on the CPU, interpreted" if planes_triton.is_interpreted() else "on CUDA"
        fits = coordinates.is_cuda or planes_triton.is_interpreted()
    if not fits or coordinates.dtype != torch.float32 or plane.dtype != torch.float32:
        raise ShapeError(
            f"planes_sample: the {backend} backend expects float32 tensors {expected}, found coordinates "
            f"{coordinates.dtype} on {coordinates.device} and a plane {plane.dtype} on {plane.device}; "
            "leave the backend out"
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
