"""How the returns of each voxel scatter together with those of the 26 voxels around it; numba on the CPU.

One thread, see `plane_fits`.
"""

import numpy as np
from numba import njit

from nvsf_core.kernels.voxel_lookup import number_at


@njit(cache=True, nogil=True)
def neighbour_moments(index, place, returns, mean_m, covariance):  # type: ignore[no-untyped-def]
    """Moments of the returns of each voxel and of those around it, each return of the same weight.

    Args:
        index: A `VoxelIndex` of v voxels.
        place: (v, 3) int64 grid coordinates, as of `VoxelIndex.places`.
        returns: (v,) number of returns of each voxel.
        mean_m: (v, 3) their means.
        covariance: (v, 3, 3) float64 their covariances, m^2.

    Returns:
        count (v,) of the returns; offset_m (v, 3) of their mean from the voxel's own; within and between
        (v, 3, 3) float64, m^2: the mean of the voxels' covariances, and the covariance of their means.
    """
    voxels = len(place)
    count, offset_m = np.zeros(voxels), np.zeros((voxels, 3))
    within, between = np.zeros((voxels, 3, 3)), np.zeros((voxels, 3, 3))
    for voxel in range(voxels):
        total, x, y, z = 0.0, 0.0, 0.0, 0.0
        own, apart = within[voxel], between[voxel]
        for step in range(27):
            other = number_at(
                place[voxel, 0] + step // 9 - 1, place[voxel, 1] + step // 3 % 3 - 1,
                place[voxel, 2] + step % 3 - 1, index.bricks, index.cells,
            )  # fmt: skip
            if other < 0:
                continue
            n = float(returns[other])
            i = float(mean_m[other, 0]) - mean_m[voxel, 0]
            j = float(mean_m[other, 1]) - mean_m[voxel, 1]
            k = float(mean_m[other, 2]) - mean_m[voxel, 2]
            total, x, y, z = total + n, x + n * i, y + n * j, z + n * k
            _add_upper(own, n, covariance[other])
            apart[0, 0] += n * i * i
            apart[0, 1] += n * i * j
            apart[0, 2] += n * i * k
            apart[1, 1] += n * j * j
            apart[1, 2] += n * j * k
            apart[2, 2] += n * k * k
        count[voxel] = total
        offset_m[voxel, 0], offset_m[voxel, 1], offset_m[voxel, 2] = x / total, y / total, z / total
        for a in range(3):
            for b in range(a, 3):
                own[a, b] /= total
                apart[a, b] = apart[a, b] / total - offset_m[voxel, a] * offset_m[voxel, b]
                own[b, a], apart[b, a] = own[a, b], apart[a, b]
    return count, offset_m, within, between


@njit(inline="always")
def _add_upper(target, n, matrix):  # type: ignore[no-untyped-def]
    """Add n times the upper triangle of a (3, 3) matrix."""
    target[0, 0] += n * matrix[0, 0]
    target[0, 1] += n * matrix[0, 1]
    target[0, 2] += n * matrix[0, 2]
    target[1, 1] += n * matrix[1, 1]
    target[1, 2] += n * matrix[1, 2]
    target[2, 2] += n * matrix[2, 2]
