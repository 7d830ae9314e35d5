"""The plane in a voxel: of its own returns, or of those around it too, where all of them lie on one plane.

A voxel of 20 cm far from the sensor has few returns. The plane through them is turned by their noise, and of
fewer than five there is none; along a ray that grazes a road a centimetre of height is a quarter of a metre
of range. Where the voxels around it go on in the same plane, that plane is known ten times better.
"""

from dataclasses import dataclass

import numpy as np

from nvsf_core.geometry.voxels import VoxelIndex
from nvsf_core.kernels.neighbour_moments import neighbour_moments
from nvsf_core.kernels.plane_fits import fit_planes

_LEAST_RETURNS = 5
_EIGENVALUE_RATIO = 4.0
_MOST_BESIDE = 0.5
_BESIDE_M = 0.015
"""Voxels go on in one plane where the variance of their means across it is at most a share of that of their
returns, and a length squared: noise moves them by less, also where it puts returns on both sides of a border
between voxels; a kerb or a bent surface moves them by more."""
_THICKEST_M = 0.06
"""Of hedges all voxels are alike, too; they are no plane."""
_RIM_M = 0.001


@dataclass(frozen=True, slots=True)
class VoxelPlanes:
    """The planes of v voxels."""

    mean_m: np.ndarray
    """(v, 3) float32: a point of the plane; where there is none, the mean of the voxel's returns."""
    normal: np.ndarray
    """(v, 3) float32 unit normal, 0 where there is no plane."""
    thickness_m: np.ndarray
    """(v,) float32: standard deviation of the returns across it."""

    def of(self, chosen: np.ndarray) -> "VoxelPlanes":
        """Of the chosen (n,) voxels."""
        return VoxelPlanes(*(getattr(self, name)[chosen] for name in self.__slots__))


def own_planes(mean_m: np.ndarray, covariance: np.ndarray, returns: np.ndarray) -> VoxelPlanes:
    """Of each voxel's own returns: means (v, 3) in metres, covariances (v, 3, 3) in m^2, numbers (v,)."""
    least, middle, normal = fit_planes(covariance)
    planar = (returns >= _LEAST_RETURNS) & (middle > _EIGENVALUE_RATIO * least)
    normal = np.where(planar[:, None], normal, 0.0).astype(np.float32)
    return VoxelPlanes(mean_m, normal, np.sqrt(np.maximum(least, 0.0)).astype(np.float32))


def joined_planes(
    index: VoxelIndex, mean_m: np.ndarray, covariance: np.ndarray, returns: np.ndarray
) -> VoxelPlanes:
    """Of the returns around each voxel too, where they go on in one plane; else as of `own_planes`.

    Args:
        index: The voxels.
        mean_m: (v, 3) float32, of each voxel's own returns.
        covariance: (v, 3, 3) float64 of these, m^2.
        returns: (v,) their numbers.
    """
    place = index.places()
    count, offset_m, within, between = neighbour_moments(index, place, returns, mean_m, covariance)
    least, middle, normal = fit_planes(within + between)
    across, beside = (np.einsum("va,vab,vb->v", normal, one, normal) for one in (within, between))
    is_one = (count >= _LEAST_RETURNS) & (middle > _EIGENVALUE_RATIO * least)
    is_one &= (beside <= _MOST_BESIDE * across + _BESIDE_M**2) & (across < _THICKEST_M**2)
    middle_m = mean_m + np.einsum("va,va->v", normal, offset_m)[:, None] * normal
    # Rays end on a plane inside of its voxel alone: one just outside would be met by none.
    low_m = index.origin_m + place * index.voxel_m
    middle_m = np.clip(middle_m, low_m + _RIM_M, low_m + index.voxel_m - _RIM_M)
    found = VoxelPlanes(
        middle_m.astype(np.float32), normal.astype(np.float32),
        np.sqrt(np.maximum(across, 0.0)).astype(np.float32),
    )  # fmt: skip
    rest = np.flatnonzero(~is_one)
    own = own_planes(mean_m[rest], covariance[rest], returns[rest])
    for name in ("mean_m", "normal", "thickness_m"):
        getattr(found, name)[rest] = getattr(own, name)
    return found
