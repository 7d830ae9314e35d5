"""Candidate surfaces of rays as flat arrays, one ray after the other, with the features of each surface."""

import math

import numpy as np
from numba import njit, prange

from nvsf_core.kernels.voxel_march import RAYS_A_TASK, walk

N_FACTS = 6
LOGIT_LIMIT = 6.0


@njit(inline="always")
def _describe(distance, opacity, cosine, is_planar, hits, intensity, at, range_m, logit, facts):  # type: ignore[no-untyped-def]
    """Write one surface's range, opacity logit and facts."""
    clipped = min(max(opacity, np.float32(1e-6)), np.float32(1.0 - 1e-6))
    odds = np.float32(math.log(clipped / (np.float32(1.0) - clipped)))
    odds = min(max(odds, np.float32(-LOGIT_LIMIT)), np.float32(LOGIT_LIMIT))
    range_m[at] = distance
    logit[at] = odds
    facts[at, 0] = odds / LOGIT_LIMIT
    facts[at, 1] = cosine
    facts[at, 2] = 1.0 if is_planar else 0.0
    facts[at, 3] = math.log1p(float(hits)) / 5.0
    facts[at, 4] = intensity
    facts[at, 5] = distance / 50.0


@njit(parallel=True, cache=True, nogil=True)
def list_surfaces(  # type: ignore[no-untyped-def]
    origins, directions, grid, surfaces, limits, met
):  # fmt: skip
    """Surfaces of n rays: static ones as of `find_candidates`, and those of moving objects, merged by range.

    Args:
        origins: (n, 3) float32, scene-local.
        directions: (n, 3) float32, of unit length.
        grid: A `VoxelIndex`.
        surfaces: `VoxelSurfaces`, the static ones.
        limits: `WalkLimits`; where a ray has more than `most` surfaces in all, the farthest are left out.
        met: `ObjectSurfaces` of the same rays, empty where nothing moves.

    Returns:
        first (n + 1,) int64: where each ray's surfaces begin; of all m surfaces: range_m (m,), opacity logit
        (m,) within +-6, facts (m, 6): logit / 6, cosine, planar?, log(1 + hits) / 5, intensity, range / 50;
        point_m (m, 3): where it lies, of an object's its place; hit prior (m,) of an object's, -1 of a static
        one.
    """
    n, most = origins.shape[0], limits.most
    normals, intensities, hits = surfaces.normal, surfaces.intensity, surfaces.hits
    row_of = np.full(n, -1, np.int64)
    for row in range(len(met.ray)):
        row_of[met.ray[row]] = row
    distance = np.empty((n, most), np.float32)
    voxels = np.empty((n, most), np.int32)
    opacity = np.empty((n, most), np.float32)
    cosine = np.empty((n, most), np.float32)
    static = np.zeros(n, np.int64)
    for task in prange((n + RAYS_A_TASK - 1) // RAYS_A_TASK):
        for ray in range(task * RAYS_A_TASK, min(n, (task + 1) * RAYS_A_TASK)):
            static[ray] = walk(
                ray, origins, directions, grid, surfaces, limits,
                (distance[ray], voxels[ray], opacity[ray], cosine[ray]),
            )  # fmt: skip
    first = np.zeros(n + 1, np.int64)
    for ray in range(n):
        row = row_of[ray]
        moving = 0 if row < 0 else met.first[row + 1] - met.first[row]
        first[ray + 1] = first[ray] + min(static[ray] + moving, most)
    count = first[n]
    range_m, logit = np.empty(count, np.float32), np.empty(count, np.float32)
    facts, point_m = np.empty((count, N_FACTS), np.float32), np.empty((count, 3), np.float32)
    hit_prior = np.full(count, -1.0, np.float32)
    for task in prange((n + RAYS_A_TASK - 1) // RAYS_A_TASK):
        for ray in range(task * RAYS_A_TASK, min(n, (task + 1) * RAYS_A_TASK)):
            row = row_of[ray]
            own = 0 if row < 0 else met.first[row]
            own_end = 0 if row < 0 else met.first[row + 1]
            i = 0
            for at in range(first[ray], first[ray + 1]):
                # Of equally near surfaces the static one comes first.
                if i < static[ray] and (own == own_end or distance[ray, i] <= met.range_m[own]):
                    voxel = voxels[ray, i]
                    is_planar = (
                        normals[voxel, 0] != 0.0 or normals[voxel, 1] != 0.0 or normals[voxel, 2] != 0.0
                    )
                    _describe(
                        distance[ray, i], opacity[ray, i], cosine[ray, i], is_planar, hits[voxel],
                        intensities[voxel], at, range_m, logit, facts,
                    )  # fmt: skip
                    for axis in range(3):
                        point_m[at, axis] = origins[ray, axis] + directions[ray, axis] * distance[ray, i]
                    i += 1
                else:
                    _describe(
                        met.range_m[own], met.opacity[own], met.cosine[own], met.is_planar[own],
                        met.hits[own], met.intensity[own], at, range_m, logit, facts,
                    )  # fmt: skip
                    for axis in range(3):
                        point_m[at, axis] = met.place_m[own, axis]
                    hit_prior[at] = met.hit_prior[own]
                    own += 1
    return first, range_m, logit, facts, point_m, hit_prior
