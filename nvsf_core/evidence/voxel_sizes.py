"""Voxels as small as the returns there allow: fine ones near the path, coarse ones where returns are sparse.

Fine voxels tell edges and thin things apart, but where returns are few, rays pass through the gaps between
them. So each brick has the finest voxels that hold at least four returns in the mean; and voxels of more than
20 cm only where they hold planes, which have no edges to lose (decision 0059). Moments of coarse voxels are
put together from those of the fine ones in them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from nvsf_core.evidence.voxel_planes import VoxelPlanes, joined_planes
from nvsf_core.geometry.voxels import BRICK, VoxelIndex, index_cells, occupied_bits

_ENOUGH_RETURNS = 4.0
"""Mean number of returns in the voxels of a brick that are fine enough."""
_ALWAYS_M, _MOSTLY = 0.3, 0.8
"""Voxels with longer edges are used where such a share of a brick's returns lies on thin planes."""
_THIN_M = 0.06
"""Standard deviation of returns across a thin plane, at most."""
_Arrays = TypeVar("_Arrays", "VoxelMoments", VoxelPlanes)
_BOX = np.stack(np.unravel_index(np.arange(BRICK**3), (BRICK,) * 3), axis=1)


@dataclass(frozen=True, slots=True)
class VoxelMoments:
    """What the returns in each of v voxels are."""

    mean_m: np.ndarray
    """(v, 3) float32."""
    covariance: np.ndarray
    """(v, 3, 3) float64, m^2."""
    returns: np.ndarray
    """(v,) int64 number of returns."""
    intensity: np.ndarray
    """(v,) float32 mean, 0..1."""

    def of(self, chosen: np.ndarray) -> "VoxelMoments":
        """Of the chosen (n,) voxels."""
        return VoxelMoments(*(getattr(self, name)[chosen] for name in self.__slots__))

    def merged(self, into: np.ndarray) -> "VoxelMoments":
        """Of coarser voxels; `into` (v,) are the numbers of those that these voxels lie in."""

        def summed(values: np.ndarray) -> np.ndarray:
            columns = values.reshape(len(into), -1).T
            total = np.stack([np.bincount(into, weights=column) for column in columns], axis=1)
            return total.reshape(-1, *values.shape[1:])

        n = self.returns[:, None]
        returns = np.bincount(into, weights=self.returns).astype(np.int64)
        mean_m = summed(n * self.mean_m) / returns[:, None]
        off_m = self.mean_m - mean_m[into]
        spread = self.covariance + off_m[:, :, None] * off_m[:, None, :]
        return VoxelMoments(
            mean_m.astype(np.float32), summed(n[:, :, None] * spread) / returns[:, None, None], returns,
            (summed(self.returns * self.intensity) / returns).astype(np.float32),
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class VoxelLevel:
    """All returns in voxels of one size."""

    index: VoxelIndex
    moments: VoxelMoments
    planes: VoxelPlanes

    @property
    def is_thin_plane(self) -> np.ndarray:
        """(v,) bool: whether the returns of a voxel lie on a plane, within some centimetres."""
        return np.asarray(self.planes.normal.any(axis=1) & (self.planes.thickness_m < _THIN_M))

    @staticmethod
    def of(index: VoxelIndex, moments: VoxelMoments) -> "VoxelLevel":
        """With planes of the voxels around, too, see `joined_planes`."""
        found = moments.mean_m, moments.covariance, moments.returns
        return VoxelLevel(index, moments, joined_planes(index, *found))

    def coarser(self) -> "VoxelLevel":
        """In voxels of twice the edge, on the same grid."""
        index, into = index_cells(self.index.places() >> 1, self.index.origin_m, 2.0 * self.index.voxel_m)
        return VoxelLevel.of(index, self.moments.merged(into))


@dataclass(frozen=True, slots=True)
class SizedVoxels:
    """Voxels that may be of several sizes, with their moments and planes."""

    index: VoxelIndex
    """Its cells are the finest voxels."""
    moments: VoxelMoments
    planes: VoxelPlanes
    edge_m: np.ndarray
    """(v,) float64 edge of each voxel, metres."""


def sized_voxels(levels: Sequence[VoxelLevel]) -> SizedVoxels:
    """Choose the size of each brick's voxels.

    Args:
        levels: The same returns in voxels of one, two, four, ... cells an edge, from the finest on.
    """
    finest = levels[0].index
    places = [one.index.places() << level for level, one in enumerate(levels)]
    brick = [finest.bricks[tuple((place // BRICK).T)] for place in places]
    level_of_brick = np.full(len(finest.cells), len(levels) - 1)
    for level in reversed(range(len(levels) - 1)):
        returns = np.bincount(brick[level], weights=levels[level].moments.returns)
        level_of_brick[returns >= _ENOUGH_RETURNS * np.bincount(brick[level])] = level
    for level in reversed([at for at, one in enumerate(levels) if one.index.voxel_m > _ALWAYS_M]):
        one = levels[level]
        returns, flat = (
            np.bincount(brick[level], weights=one.moments.returns * share) for share in (1, one.is_thin_plane)
        )
        level_of_brick[(level_of_brick == level) & (flat < _MOSTLY * returns)] = level - 1
    cells = np.full_like(finest.cells, -1)
    chosen = [np.flatnonzero(level_of_brick[row] == level) for level, row in enumerate(brick)]
    first = np.cumsum([0, *map(len, chosen)])
    for level, voxels in enumerate(chosen):
        number = first[level] + np.arange(len(voxels))
        for offset in _BOX[(1 << level > _BOX).all(axis=1)]:
            x, y, z = ((places[level][voxels] + offset) % BRICK).T
            cells[brick[level][voxels], (x * BRICK + y) * BRICK + z] = number
    both = list(zip(levels, chosen, strict=True))
    return SizedVoxels(
        index=VoxelIndex(
            finest.origin_m, finest.voxel_m, finest.bricks, cells, occupied_bits(cells), 1 << level_of_brick
        ),
        moments=_joined([one.moments.of(voxels) for one, voxels in both]),
        planes=_joined([one.planes.of(voxels) for one, voxels in both]),
        edge_m=np.concatenate([np.full(len(voxels), one.index.voxel_m) for one, voxels in both]),
    )


def _joined(parts: list[_Arrays]) -> _Arrays:
    kind = type(parts[0])
    return kind(*(np.concatenate([getattr(part, name) for part in parts]) for name in kind.__slots__))
