"""Multiresolution hash grids: their memory layout, and the encoding, by a kernel for device and type."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from math import ceil

from torch import Tensor

from nvsf_core.errors import RecipeError, ShapeError
from nvsf_core.kernels.encodings.backend import (
    Backend,
    Kernels,
    choose_backend,
    interpolate,
    require_backend,
)

__all__ = ["PRIMES", "GridLayout", "hash_grid_encode"]

PRIMES = (1, 2654435761, 805459861)
"""Factors of the XOR hash for x, y, z (Müller et al. 2022, eq. 4; after Teschner et al. 2003)."""


@dataclass(frozen=True)
class GridLayout:
    """A multiresolution hash grid (Müller et al. 2022) in 2 or 3 dimensions, with tiny-cuda-nn's conventions.

    Level l has ``scale = base * growth^l - 1`` and ``ceil(scale) + 1`` grid points along an axis; a
    position x in [0, 1] is at ``x * scale + 0.5`` in grid units. A level is dense if all its points fit into
    ``2^log2_table`` entries, else hashed. Scales are rounded to 1e-6, so that resolutions do not depend on
    the last bit of a power (which makes 32 769 of the finest level's 32 768 in the authors' code).

    Attributes:
        levels: Number of levels, at least 1.
        features: Numbers in an entry, at least 1.
        log2_table: Binary logarithm of a level's largest number of entries.
        base_resolution: Grid points along an axis of the coarsest level, at least 2.
        finest_resolution: The same of the finest level; ignored with one level.
        dimensions: Axes of a position, 2 or 3; by name only.

    Raises:
        RecipeError: A value is outside its interval.
    """

    levels: int
    features: int
    log2_table: int
    base_resolution: int
    finest_resolution: int
    dimensions: int = field(default=3, kw_only=True)

    def __post_init__(self) -> None:
        """Refuse sizes outside their intervals."""
        for name, low, high in (
            ("levels", 1, 64),
            ("features", 1, 64),
            ("log2_table", 1, 30),
            ("base_resolution", 2, 1 << 20),
            ("finest_resolution", self.base_resolution, 1 << 20),
            ("dimensions", 2, 3),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise RecipeError(
                    f"GridLayout.{name}: expected a whole number in [{low}, {high}], found {value}; "
                    "correct the recipe's grid"
                )

    @property
    def growth(self) -> float:
        """Factor between the resolutions of neighbouring levels; 1 for a single level."""
        if self.levels == 1:
            return 1.0
        return float((self.finest_resolution / self.base_resolution) ** (1.0 / (self.levels - 1)))

    @property
    def table_entries(self) -> int:
        """Number of entries of a hashed level, a power of two."""
        return 1 << self.log2_table

    @cached_property
    def scales(self) -> tuple[float, ...]:
        """Cells along an axis of the unit box, per level; not whole numbers in general."""
        base, growth = self.base_resolution, self.growth
        return tuple(round(base * growth**level - 1.0, 6) for level in range(self.levels))

    @cached_property
    def resolutions(self) -> tuple[int, ...]:
        """Grid points along an axis, per level."""
        return tuple(ceil(scale) + 1 for scale in self.scales)

    @cached_property
    def is_dense(self) -> tuple[bool, ...]:
        """Whether every grid point has an entry of its own, per level."""
        return tuple(resolution**self.dimensions <= self.table_entries for resolution in self.resolutions)

    @cached_property
    def offsets(self) -> tuple[int, ...]:
        """First entry of each level, then the number of all entries: levels + 1 numbers."""
        offsets = [0]
        for resolution, dense in zip(self.resolutions, self.is_dense, strict=True):
            # Multiples of 8 entries, as in tiny-cuda-nn, so that every level starts aligned.
            points = -(-(resolution**self.dimensions) // 8) * 8
            offsets.append(offsets[-1] + (min(points, self.table_entries) if dense else self.table_entries))
        return tuple(offsets)

    @property
    def corners(self) -> int:
        """Grid points around a position: 4 or 8."""
        return 1 << self.dimensions

    @property
    def entries(self) -> int:
        """Number of rows of the table."""
        return self.offsets[-1]

    @property
    def outputs(self) -> int:
        """Length of a position's encoding: levels * features."""
        return self.levels * self.features


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
    backend = backend or choose_backend(positions, table)
    if backend == "torch":
        from nvsf_core.kernels.encodings import hash_grid_torch

        return hash_grid_torch.encode(positions, table, layout)
    require_backend(backend, positions, table, what=("hash_grid_encode", "positions", "table"))
    # Importing numba takes 0.3 s, not every machine has Triton: each is imported where it is used.
    if backend == "numba":
        from nvsf_core.kernels.encodings import hash_grid_numba as chosen
    else:
        from nvsf_core.kernels.encodings import hash_grid_triton as chosen  # type: ignore[no-redef]
    kernels = Kernels(
        backend,
        lambda x, entries: chosen.encode(x, entries, layout),
        lambda x, entries, grad: chosen.position_adjoint(x, entries, grad, layout),
        lambda x, grad: chosen.adjoint(x, grad, layout),
    )
    return interpolate(positions, table, kernels)


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
