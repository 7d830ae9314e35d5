"""How the returns of each voxel scatter together with those of the 26 voxels around it; numba on the CPU."""

import numpy as np
from numba import njit, prange

_BRICK = 8
_VOXELS_A_TASK = 1024


@njit(inline="always")
def _number_at(x, y, z, bricks, cells):  # type: ignore[no-untyped-def]
    """Number of the voxel at grid coordinates, -1 where there is none."""
    if x < 0 or y < 0 or z < 0:
        return -1
    i, j, k = x // _BRICK, y // _BRICK, z // _BRICK
    if i >= bricks.shape[0] or j >= bricks.shape[1] or k >= bricks.shape[2] or bricks[i, j, k] < 0:
        return -1
    return cells[bricks[i, j, k], (x % _BRICK * _BRICK + y % _BRICK) * _BRICK + z % _BRICK]


@njit(parallel=True, cache=True, nogil=True)
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
    for task in prange((voxels + _VOXELS_A_TASK - 1) // _VOXELS_A_TASK):
        apart = np.zeros(3)
        for voxel in range(task * _VOXELS_A_TASK, min(voxels, (task + 1) * _VOXELS_A_TASK)):
            for step in range(27):
                other = _number_at(
                    place[voxel, 0] + step // 9 - 1, place[voxel, 1] + step // 3 % 3 - 1,
                    place[voxel, 2] + step % 3 - 1, index.bricks, index.cells,
                )  # fmt: skip
                if other < 0:
                    continue
                n = returns[other]
                count[voxel] += n
                for a in range(3):
                    apart[a] = float(mean_m[other, a]) - mean_m[voxel, a]
                    offset_m[voxel, a] += n * apart[a]
                for a in range(3):
                    for b in range(3):
                        within[voxel, a, b] += n * covariance[other, a, b]
                        between[voxel, a, b] += n * apart[a] * apart[b]
            for a in range(3):
                offset_m[voxel, a] /= count[voxel]
            for a in range(3):
                for b in range(3):
                    within[voxel, a, b] /= count[voxel]
                    between[voxel, a, b] = (
                        between[voxel, a, b] / count[voxel] - offset_m[voxel, a] * offset_m[voxel, b]
                    )
    return count, offset_m, within, between
