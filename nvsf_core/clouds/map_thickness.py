"""How sharp a map is: the thickness of what should be surfaces."""

import numpy as np

_VOXEL_M = 0.4


def map_thickness_m(points_m: np.ndarray) -> float:
    """Thickness of the map's surfaces: median over flat voxels of the standard deviation across the plane.

    A voxel is flat if it has at least 30 points and its covariance's second eigenvalue is above four times
    the smallest.

    Args:
        points_m: (n, 3) points of all scans, scene-local, metres.

    Returns:
        Metres; NaN if no voxel is flat.
    """
    cell = np.floor(points_m / _VOXEL_M).astype(np.int64)
    cell -= cell.min(axis=0, initial=0)
    size = cell.max(axis=0, initial=0) + 1
    _, voxel, count = np.unique((cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2],
                                return_inverse=True, return_counts=True)  # fmt: skip
    mean = np.stack([np.bincount(voxel, points_m[:, k]) / count for k in range(3)], axis=-1)
    apart = points_m - mean[voxel]
    covariance = np.zeros((len(count), 3, 3))
    for i in range(3):
        for k in range(3):
            covariance[:, i, k] = np.bincount(voxel, apart[:, i] * apart[:, k]) / count
    eigenvalue = np.linalg.eigvalsh(covariance[count >= 30])
    flat = eigenvalue[eigenvalue[:, 1] > 4.0 * eigenvalue[:, 0], 0]
    return float(np.sqrt(np.median(np.maximum(flat, 0.0)))) if len(flat) else float("nan")
