"""Multiresolution hash grids: memory layout, encoding by a kernel for device and type, trainable table."""

from dataclasses import dataclass, field
from functools import cached_property
from math import ceil

import numpy as np
import torch
from torch import Tensor, nn

from nvsf_core.errors import RecipeError, ShapeError
from nvsf_core.kernels.encodings.backend import (
    Backend,
    Kernels,
    choose_backend,
    interpolate,
    require_backend,
)
from nvsf_core.recipe.residual import FieldSpec

PRIMES = (1, 2654435761, 805459861)
"""Factors of the XOR hash for x, y, z (Müller et al. 2022, eq. 4; after Teschner et al. 2003)."""
INITIAL_BOUND = 1e-4
"""Initial entries are uniform within plus/minus this (as in tiny-cuda-nn)."""


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
        from nvsf_core.kernels.encodings import oracles_torch

        return oracles_torch.encode(positions, table, layout)
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


def grid_layout(spec: FieldSpec, edge_m: float) -> GridLayout:
    """The hash grid whose cells have the recipe's sizes in a cube of edge `edge_m`."""
    return GridLayout(
        levels=spec.levels,
        features=spec.features,
        log2_table=spec.log2_table,
        base_resolution=max(2, round(edge_m / spec.coarsest_cell_m)),
        finest_resolution=max(4, round(edge_m / spec.finest_cell_m)),
    )


class HashGrid(nn.Module):
    """Hash-grid features of positions in the unit box (or square), from a trainable table.

    Two grids of one layout, made one after the other from one generator, start with different numbers
    (the authors seed every module with 1337, so theirs start equal).

    Attributes:
        layout: Sizes of the grid.
        table: (layout.entries, layout.features) float32, initially U(-1e-4, 1e-4).
    """

    def __init__(self, layout: GridLayout, generator: torch.Generator) -> None:
        """Sample the table's initial numbers on the CPU."""
        super().__init__()
        self.layout = layout
        shape = (layout.entries, layout.features)
        if torch.get_default_device().type == "meta":  # shapes without memory, to count parameters
            table = torch.empty(shape)
        else:
            # numpy, unlike torch, requests huge pages: look-ups in a large table are up to 1.5 times faster
            table = torch.from_numpy(np.empty(shape, dtype=np.float32))
        self.table = nn.Parameter(table.uniform_(-INITIAL_BOUND, INITIAL_BOUND, generator=generator))

    @property
    def outputs(self) -> int:
        """Length of a position's encoding."""
        return self.layout.outputs

    def forward(self, positions: Tensor) -> Tensor:
        """Encode positions (..., layout.dimensions), clamped to [0, 1], as (..., levels * features)."""
        flat = positions.reshape(-1, self.layout.dimensions)
        return hash_grid_encode(flat, self.table, self.layout).reshape(*positions.shape[:-1], self.outputs)


def start_alike(module: nn.Module) -> None:
    """Give all grids of one layout in a module equal numbers, as in the authors' code (one seed for all)."""
    first: dict[GridLayout, Tensor] = {}
    for grid in module.modules():
        if isinstance(grid, HashGrid):
            with torch.no_grad():
                grid.table.copy_(first.setdefault(grid.layout, grid.table))
