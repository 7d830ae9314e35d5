"""Bilinear interpolation in feature planes: one function, which chooses the kernel by device and type."""

from torch import Tensor

from nvsf_core.errors import ShapeError
from nvsf_core.kernels.encodings.backend import (
    Backend,
    Kernels,
    choose_backend,
    interpolate,
    require_backend,
)


def planes_sample(coordinates: Tensor, plane: Tensor, backend: Backend | None = None) -> Tensor:
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
    backend = backend or choose_backend(coordinates, plane)
    if backend == "torch":
        from nvsf_core.kernels.encodings import oracles_torch

        return oracles_torch.sample(coordinates, plane)
    require_backend(backend, coordinates, plane, what=("planes_sample", "coordinates", "a plane"))
    # Importing numba takes 0.3 s, not every machine has Triton: each is imported where it is used.
    if backend == "numba":
        from nvsf_core.kernels.encodings import planes_numba as chosen
    else:
        from nvsf_core.kernels.encodings import planes_triton as chosen  # type: ignore[no-redef]
    shape = plane.shape
    kernels = Kernels(
        backend, chosen.sample, chosen.coordinate_adjoint, lambda x, grad: chosen.adjoint(x, grad, shape)
    )
    return interpolate(coordinates, plane, kernels)


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
