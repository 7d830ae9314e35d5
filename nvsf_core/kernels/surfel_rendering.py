"""LiDAR rays rendered from surfels alone, walked and composited in one pass without a list of surfaces."""

import numpy as np
from numba import njit, prange

from nvsf_core.kernels.voxel_march import RAYS_A_TASK, walk

_HANDS = 16
"""Groups that tasks are dealt out to, so that each thread gets an equal share of every part of a sweep."""


@njit(parallel=True, cache=True, nogil=True)
def render_by_surfels(  # type: ignore[no-untyped-def]
    origins, directions, grid, surfaces, limits
):  # fmt: skip
    """The weighted median surface of each ray, of those that `find_candidates` gives with the same arguments.

    Args:
        origins: (n, 3) float32, scene-local.
        directions: (n, 3) float32, of unit length.
        grid: A `VoxelIndex`.
        surfaces: `VoxelSurfaces`.
        limits: `WalkLimits`.

    Weights are w_i = a_i prod_{j<i} (1 - a_j); the median is the first surface with
    ``sum up to i >= half of the total``, the intensity the mean of the voxels' intensities by weight.

    Returns:
        range_m (n,) float32, infinite without a surface; intensity (n,) float32, 0 there.
    """
    n, most, intensities = origins.shape[0], limits.most, surfaces.intensity
    range_m = np.full(n, np.inf, np.float32)
    intensity = np.zeros(n, np.float32)
    half, one = np.float32(0.5), np.float32(1.0)
    tasks = (n + RAYS_A_TASK - 1) // RAYS_A_TASK
    turns = (tasks + _HANDS - 1) // _HANDS
    for number in prange(turns * _HANDS):
        # Each thread gets consecutive numbers, and a laser's rays walk about as far: upper ones far, lower
        # ones not. Dealt out like cards, every thread gets of all; a number past the last finds no ray.
        task = number % turns * _HANDS + number // turns
        distance = np.empty(most, np.float32)
        voxel = np.empty(most, np.int32)
        opacity = np.empty(most, np.float32)
        cosine = np.empty(most, np.float32)
        for ray in range(task * RAYS_A_TASK, min(n, (task + 1) * RAYS_A_TASK)):
            count = walk(ray, origins, directions, grid, surfaces, limits, (distance, voxel, opacity, cosine))
            if count == 0:
                continue
            light = one
            total = 0.0
            shine = 0.0
            for i in range(count):
                weight = opacity[i] * light
                light = light * (one - opacity[i])
                opacity[i] = weight
                total += weight
                shine += weight * intensities[voxel[i]]
            chosen = 0
            so_far = float(opacity[0])
            # In float32, as `weighted_median_index` compares.
            while np.float32(so_far) < half * np.float32(total):
                chosen += 1
                so_far += opacity[chosen]
            range_m[ray] = distance[chosen]
            intensity[ray] = shine / total
    return range_m, intensity
