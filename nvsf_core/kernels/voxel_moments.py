"""Mean and covariance of the points in each voxel, in numba."""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def voxel_moments(points_m, voxel, returns):  # type: ignore[no-untyped-def]
    """Mean (v, 3) and covariance (v, 3, 3) float64 of each voxel's points, metres.

    Args:
        points_m: (n, 3) metres.
        voxel: (n,) number of the voxel of each point, from `index_points`.
        returns: (v,) number of points in each voxel, at least 1.
    """
    mean, covariance = np.zeros((len(returns), 3)), np.zeros((len(returns), 3, 3))
    for point in range(len(voxel)):
        for axis in range(3):
            mean[voxel[point], axis] += points_m[point, axis]
    for number in range(len(returns)):
        mean[number] /= returns[number]
    for point in range(len(voxel)):
        number = voxel[point]
        x = points_m[point, 0] - mean[number, 0]
        y = points_m[point, 1] - mean[number, 1]
        z = points_m[point, 2] - mean[number, 2]
        own = covariance[number]
        own[0, 0] += x * x
        own[0, 1] += x * y
        own[0, 2] += x * z
        own[1, 1] += y * y
        own[1, 2] += y * z
        own[2, 2] += z * z
    for number in range(len(returns)):
        own = covariance[number]
        for a in range(3):
            for b in range(a, 3):
                own[a, b] /= returns[number]
                own[b, a] = own[a, b]
    return mean, covariance
