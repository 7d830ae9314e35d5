"""Surfels: the surface in each voxel, and how often the voxel stopped a ray or let it pass."""

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from nvsf_core.errors import ShapeError
from nvsf_core.evidence.voxel_planes import joined_planes, own_planes
from nvsf_core.evidence.voxel_sizes import SizedVoxels, VoxelLevel, VoxelMoments, sized_voxels
from nvsf_core.geometry.voxels import BRICK, VoxelIndex, index_points, occupied_bits
from nvsf_core.kernels.voxel_march import VoxelSurfaces, WalkLimits, find_candidates
from nvsf_core.kernels.voxel_moments import voxel_moments
from nvsf_core.kernels.voxel_passes import count_passes

_STOP_TRANSMITTANCE = 0.02
"""Less light hardly ever decides which surface is the median, nor much of the intensity (decision 0060)."""
_FAINTEST = 1e-9
"""Share of the light that a surface stops at least: a plane that a ray misses by 20 cm, inside a large voxel,
is no surface to it."""
_FINEST_M, _FIELD_M = 0.1, 0.2
"""Edges of the finest voxels of `reproject`, and of those that a field corrects: finer ones do not lower its
error and make its steps longer."""
COARSEST_M = (0.2, 0.4, 0.8)
"""Edges that the coarsest voxels of a drive may have."""
_NEARLY = 0.99
"""Edges that differ by less are the same."""
_MOST_BRICKS = 30_000_000
"""Most bricks, of four bytes each, that a scene's box of the finest voxels may have."""
_MARGIN = 0.25
"""Voxels before its return up to which a ray passes through voxels."""
_NOISE_M = 0.005
"""Smallest standard deviation of returns from one surface."""
_DOUBT, _DOUBT_OF_PLANES = 0.3, 3.0
"""Weight, in returns, of a prior that they are spread evenly over the voxel, for the covariance. A few
returns of a plane say little about where it ends: most planes go on in the voxel beside."""
_NO_SHAPES = np.zeros((0, 6), np.float32)


@dataclass(frozen=True)
class Surfels:
    """One surface element per occupied voxel; arrays are in the order of the index's voxel numbers."""

    index: VoxelIndex
    mean_m: np.ndarray
    """(v, 3) float32: mean of the voxel's returns, scene-local metres."""
    normal: np.ndarray
    """(v, 3) float32: unit normal of the voxel's plane, 0 where there is none."""
    precision: np.ndarray
    """(v, 6) float32, 1/m^2: inverse covariance of the voxel's returns as xx, xy, xz, yy, yz, zz; of a
    plane's along it alone; (0, 6) for surfels without shapes."""
    thickness_m: np.ndarray
    """(v,) float32 metres: standard deviation across the plane."""
    intensity: np.ndarray
    """(v,) float32: mean intensity of the voxel's returns."""
    hits: np.ndarray
    """(v,) int32: number of rays that ended in the voxel."""
    passes: np.ndarray
    """(v,) int32: number of rays that met the returns, within their shape where they have one, and passed."""

    ARRAYS: ClassVar[tuple[str, ...]] = (
        "grid_origin_m", "voxel_m", "bricks", "cells", "edges", "mean_m", "normal", "precision",
        "thickness_m", "intensity", "hits", "passes",
    )  # fmt: skip
    """Names under which the arrays are stored."""

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Named arrays that `from_arrays` reads back."""
        grid = {
            "grid_origin_m": self.index.origin_m, "voxel_m": np.array([self.index.voxel_m]),
            "bricks": self.index.bricks, "cells": self.index.cells, "edges": self.index.edges,
        }  # fmt: skip
        return grid | {name: getattr(self, name) for name in self.ARRAYS if name not in grid}

    @staticmethod
    def from_arrays(arrays: dict[str, np.ndarray]) -> "Surfels":
        """Read back what `to_arrays` gave; other names are ignored."""
        a = arrays
        return Surfels(
            index=VoxelIndex(
                a["grid_origin_m"], float(a["voxel_m"][0]), a["bricks"], a["cells"],
                occupied_bits(a["cells"]), a["edges"],
            ),
            mean_m=a["mean_m"], normal=a["normal"], precision=a["precision"], thickness_m=a["thickness_m"],
            intensity=a["intensity"], hits=a["hits"], passes=a["passes"],
        )  # fmt: skip

    @property
    def count(self) -> int:
        """Number of surfels; faster than the index's own count."""
        return len(self.hits)

    @cached_property
    def opacity(self) -> np.ndarray:
        """(v,) float32: share of the rays that ended here; its prior counts keep it between 0 and 1."""
        return ((self.hits + 0.1) / (self.hits + self.passes + 0.2)).astype(np.float32)

    @property
    def surfaces(self) -> VoxelSurfaces:
        """As the kernels take them."""
        return VoxelSurfaces(
            self.mean_m, self.normal, self.precision, self.opacity, self.intensity, self.hits
        )

    def walk_limits(
        self, near_m: float, far_m: float, most: int, *,
        stop_transmittance: float = _STOP_TRANSMITTANCE, faintest: float = _FAINTEST,
    ) -> WalkLimits:  # fmt: skip
        """Limits of a walk through these surfels.

        Args:
            near_m: Where it begins.
            far_m: Where it ends.
            most: Surfaces after which it ends.
            stop_transmittance: Share of the light below which it ends.
            faintest: Share of the light that a surface must stop; others are left out.

        Raises:
            ShapeError: `most` is below 1.
        """
        # The kernels write a surface before they count it: without room for one, into foreign memory.
        if most < 1:
            raise ShapeError(f"walk_limits: expected room for at least 1 surface a ray, found {most}")
        return WalkLimits(float(near_m), float(far_m), most, stop_transmittance, faintest)

    @property
    def is_planar(self) -> np.ndarray:
        """(v,) bool: whether the returns lie on a plane."""
        return np.asarray(np.any(self.normal != 0, axis=1))


@dataclass(frozen=True, slots=True)
class Candidates:
    """Surfaces on which rays may end, in order along each ray; see `find_candidates`."""

    range_m: np.ndarray
    """(r, k) float32 metres."""
    voxel: np.ndarray
    """(r, k) int32 number of the surfel, -1 where there is none."""
    opacity: np.ndarray
    """(r, k) float32, 0 where there is none."""
    cosine: np.ndarray
    """(r, k) float32: |cos| of the angle between ray and normal."""

    @property
    def weights(self) -> np.ndarray:
        """(r, k) float32 w_i = a_i * prod_{j<i} (1 - a_j) with opacities a."""
        light = np.cumprod(1.0 - self.opacity, axis=1)
        before = np.concatenate([np.ones_like(light[:, :1]), light[:, :-1]], axis=1)
        return np.asarray(self.opacity * before)


# Wide: four arrays are columns of the same rays; the rest are independent settings.
def build_surfels(
    origin_m: np.ndarray,
    direction: np.ndarray,
    range_m: np.ndarray,
    intensity: np.ndarray,
    *,
    voxel_m: float,
    is_surface: np.ndarray | None = None,
    joined: bool = True,
    has_shapes: bool = False,
) -> Surfels:
    """Surfels of the returns of rays in voxels of one size.

    A ray passes through a voxel whose plane it meets, or misses by at most a centimetre, or that it crosses
    if there is no plane, up to a quarter of a voxel before its return. So a road stays opaque below rays that
    graze it.

    Args:
        origin_m: (n, 3) scene-local, metres.
        direction: (n, 3) unit, scene-local axes.
        range_m: (n,) metres to the return.
        intensity: (n,) of the return, 0..1.
        voxel_m: Edge of a voxel.
        is_surface: (n,) bool: the return is part of a surface. False for example on moving objects, whose
            rays then only pass through voxels. None = all are.
        joined: Whether planes are those of the voxels around, too (`joined_planes`): no small object's, past
            whose edges rays would see.
        has_shapes: See `StaticReturns.shown`.
    """
    kept = np.ones(len(range_m), bool) if is_surface is None else is_surface
    returns = _Returns.of(origin_m, direction, range_m, intensity, voxel_m, kept)
    moments = returns.moments
    found = (moments.mean_m, moments.covariance, moments.returns)
    planes = joined_planes(returns.index, *found) if joined else own_planes(*found)
    edge_m = np.full(len(moments.returns), voxel_m)
    return returns.surfels(SizedVoxels(returns.index, moments, planes, edge_m), has_shapes=has_shapes)


@dataclass(frozen=True, slots=True)
class StaticReturns:
    """The returns of a static scene in voxels of several sizes, ready to be made surfels of."""

    returns: "_Returns"
    levels: tuple[VoxelLevel, ...]
    """From voxels of 10 cm to voxels of 80 cm."""

    @staticmethod
    def of(
        origin_m: np.ndarray, direction: np.ndarray, range_m: np.ndarray, intensity: np.ndarray,
        is_static: np.ndarray,
    ) -> "StaticReturns":  # fmt: skip
        """Those of a drive.

        Args:
            origin_m: (n, 3) scene-local, metres.
            direction: (n, 3) unit, scene-local axes.
            range_m: (n,) metres to the return.
            intensity: (n,) of the return, 0..1.
            is_static: (n,) bool: the return is part of the static scene; the others' rays only pass through.
        """
        finest_m = _finest_m(origin_m + direction * range_m[:, None])
        returns = _Returns.of(origin_m, direction, range_m, intensity, finest_m, is_static)
        levels = [VoxelLevel.of(returns.index, returns.moments)]
        while levels[-1].index.voxel_m < _NEARLY * COARSEST_M[-1]:
            levels.append(levels[-1].coarser())
        return StaticReturns(returns, tuple(levels))

    def field(self, coarsest_m: float) -> Surfels:
        """For a field to learn from: without shapes, in voxels from 20 cm up to an edge of `coarsest_m`."""
        return self.returns.surfels(sized_voxels(self._levels(_FIELD_M, coarsest_m)), has_shapes=False)

    def shown(self, coarsest_m: float) -> Surfels:
        """For `reproject`: with shapes, in voxels from 10 cm up to an edge of `coarsest_m`.

        With shapes a ray passes through a voxel only where it comes as near to the voxel's returns as one of
        them would: a wall stays opaque beside a gap. A field learns less from shapes and from voxels of 10 cm
        (decisions 0058 and 0059).
        """
        return self.returns.surfels(sized_voxels(self._levels(0.0, coarsest_m)), has_shapes=True)

    def _levels(self, finest_m: float, coarsest_m: float) -> list[VoxelLevel]:
        return [one for one in self.levels if _NEARLY * finest_m < one.index.voxel_m < coarsest_m / _NEARLY]


def _finest_m(points_m: np.ndarray) -> float:
    """Edge of the finest voxels of returns (n, 3): 10 cm, or a field's where their box is too large."""
    bricks = np.prod(np.ptp(points_m, axis=0) / (_FINEST_M * BRICK) + 1.0) if len(points_m) else 0.0
    return _FINEST_M if bricks <= _MOST_BRICKS else _FIELD_M


@dataclass(frozen=True, slots=True)
class _Returns:
    """Rays, and what their returns tell of each of v voxels of one size."""

    rays: tuple[np.ndarray, np.ndarray, np.ndarray]
    """Origins and directions (n, 3), and ranges (n,), float32."""
    voxel: np.ndarray
    """(m,) int32 number of the voxel of each of the m returns that are part of a surface."""
    kept: np.ndarray
    """(n,) bool: whether a ray's return is."""
    index: VoxelIndex
    moments: VoxelMoments

    @staticmethod
    def of(
        origin_m: np.ndarray, direction: np.ndarray, range_m: np.ndarray, intensity: np.ndarray,
        voxel_m: float, kept: np.ndarray,
    ) -> "_Returns":  # fmt: skip
        """Arguments as of `build_surfels`."""
        points = origin_m[kept] + direction[kept] * range_m[kept, None]
        index, voxel = index_points(points, voxel_m)
        hits = np.bincount(voxel, minlength=index.voxel_count)
        mean, covariance = voxel_moments(points, voxel, hits)
        shine = np.bincount(voxel, weights=intensity[kept], minlength=index.voxel_count)
        origin, ray = (np.ascontiguousarray(vectors, np.float32) for vectors in (origin_m, direction))
        moments = VoxelMoments(mean.astype(np.float32), covariance, hits, (shine / hits).astype(np.float32))
        return _Returns((origin, ray, range_m), voxel, kept, index, moments)

    def surfels(self, voxels: SizedVoxels, *, has_shapes: bool) -> Surfels:
        """The surfels of these returns in voxels that were made from them."""
        index, moments, planes = voxels.index, voxels.moments, voxels.planes
        precision = _precision(voxels) if has_shapes else _NO_SHAPES
        origin_m, direction, range_m = self.rays
        # How many of the finest voxels an edge of these voxels' cells has.
        cells = round(index.voxel_m / self.index.voxel_m)
        margin_m = np.full(len(range_m), index.voxel_m, np.float32)
        margin_m[self.kept] *= index.edges_of(self.index.places() // cells)[self.voxel]
        stop_m = np.maximum(range_m - _MARGIN * margin_m, 0).astype(np.float32)
        crossed, met = count_passes(
            origin_m, direction, stop_m, index, planes.mean_m, planes.normal, precision
        )
        return Surfels(
            index=index, mean_m=planes.mean_m, normal=planes.normal, precision=precision,
            thickness_m=planes.thickness_m, intensity=moments.intensity,
            hits=moments.returns.astype(np.int32), passes=met if has_shapes else crossed,
        )  # fmt: skip


def candidates_of(
    surfels: Surfels, origin_m: np.ndarray, direction: np.ndarray, *, most: int, near_m: float, far_m: float
) -> Candidates:
    """Surfaces on which rays may end.

    Args:
        surfels: All surfaces.
        origin_m: (n, 3) in the surfels' frame, metres.
        direction: (n, 3) unit.
        most: Most surfaces per ray.
        near_m: Least range.
        far_m: Greatest range.

    Raises:
        ShapeError: `most` is below 1.
    """
    range_m, voxel, opacity, cosine, _ = find_candidates(
        np.ascontiguousarray(origin_m, np.float32),
        np.ascontiguousarray(direction, np.float32),
        surfels.index,
        surfels.surfaces,
        surfels.walk_limits(near_m, far_m, most),
    )
    return Candidates(range_m, voxel, opacity, cosine)


def _precision(voxels: SizedVoxels) -> np.ndarray:
    """Inverse covariances (v, 6) float32, 1/m^2, smoothed where returns are few; of planes along them."""
    normal, covariance, hits = voxels.planes.normal, voxels.moments.covariance, voxels.moments.returns
    across = normal[:, :, None].astype(np.float64) * normal[:, None, :]
    doubt = np.where(normal.any(axis=1), _DOUBT_OF_PLANES, _DOUBT)[:, None, None]
    # A coordinate that is even over a voxel has the variance edge_m^2 / 12.
    even, noise = voxels.edge_m[:, None, None] ** 2 / 12.0 * np.eye(3), _NOISE_M**2 * np.eye(3)
    smoothed = (covariance * hits[:, None, None] + doubt * even) / (hits[:, None, None] + doubt) + noise
    along = np.eye(3) - across
    precision = np.linalg.inv(along @ smoothed @ along + across) - across
    rows, columns = np.triu_indices(3)
    # In the order in which it is read from a store: a kernel is compiled for each.
    return np.ascontiguousarray(precision[:, rows, columns], np.float32)


def weighted_median_index(weights: np.ndarray) -> np.ndarray:
    """Index (r,) of the median sample by weights (r, k): the first at which half of the total is reached.

    On a ray that meets an edge the mean lies in the air between both surfaces; the median lies on one.
    A ray of total weight 0 gives index 0.
    """
    # Added in float64 and compared as the weights are, as `render_by_surfels` does.
    so_far = np.cumsum(weights, axis=1, dtype=np.float64).astype(weights.dtype)
    return np.asarray((so_far >= 0.5 * so_far[:, -1:]).argmax(axis=1))
