"""The plane in a voxel: of its own returns, or of those around it too, where all of them lie on one plane.

A voxel of 20 cm far from the sensor has few returns. The plane through them is turned by their noise, and of
fewer than five there is none; along a ray that grazes a road a centimetre of height is a quarter of a metre
of range. Where the voxels around it go on in the same plane, that plane is known ten times better.
"""

from dataclasses import dataclass

import numpy as np

from nvsf_core.geometry.voxels import VoxelIndex
from nvsf_core.kernels.neighbour_moments import neighbour_moments

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


def own_planes(mean_m: np.ndarray, covariance: np.ndarray, returns: np.ndarray) -> VoxelPlanes:
    """Of each voxel's own returns: means (v, 3) in metres, covariances (v, 3, 3) in m^2, numbers (v,)."""
    values, vectors = np.linalg.eigh(covariance)
    planar = (returns >= _LEAST_RETURNS) & (values[:, 1] > _EIGENVALUE_RATIO * values[:, 0])
    normal = np.where(planar[:, None], vectors[:, :, 0], 0.0).astype(np.float32)
    return VoxelPlanes(mean_m, normal, np.sqrt(np.maximum(values[:, 0], 0.0)).astype(np.float32))


def joined_planes(
    index: VoxelIndex, own: VoxelPlanes, covariance: np.ndarray, returns: np.ndarray
) -> VoxelPlanes:
    """The planes of the voxels of an index, of the returns around each too where they go on in one plane.

    Args:
        index: The voxels.
        own: Of their own returns.
        covariance: (v, 3, 3) float64 of these, m^2.
        returns: (v,) their numbers.
    """
    place = index.places()
    count, offset_m, within, between = neighbour_moments(index, place, returns, own.mean_m, covariance)
    values, vectors = np.linalg.eigh(within + between)
    normal = vectors[:, :, 0]
    across, beside = (np.einsum("va,vab,vb->v", normal, one, normal) for one in (within, between))
    is_one = (count >= _LEAST_RETURNS) & (values[:, 1] > _EIGENVALUE_RATIO * values[:, 0])
    is_one &= (beside <= _MOST_BESIDE * across + _BESIDE_M**2) & (across < _THICKEST_M**2)
    middle_m = own.mean_m + np.einsum("va,va->v", normal, offset_m)[:, None] * normal
    # Rays end on a plane inside of its voxel alone: one just outside would be met by none.
    low_m = index.origin_m + place * index.voxel_m
    middle_m = np.clip(middle_m, low_m + _RIM_M, low_m + index.voxel_m - _RIM_M)
    thickness_m = np.sqrt(np.maximum(across, 0.0))
    return VoxelPlanes(
        np.where(is_one[:, None], middle_m, own.mean_m).astype(np.float32),
        np.where(is_one[:, None], normal, own.normal).astype(np.float32),
        np.where(is_one, thickness_m, own.thickness_m).astype(np.float32),
    )
