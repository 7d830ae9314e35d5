"""Unobserved voxels beside surfels: no ray met or crossed them, so the surface may continue there."""

import numpy as np

from nvsf_core.evidence.surfels import Surfels
from nvsf_core.geometry.voxels import index_points
from nvsf_core.kernels.voxel_march import count_passes

_FACES = np.concatenate([np.eye(3, dtype=np.int64), -np.eye(3, dtype=np.int64)])
_NO_SHAPES = np.zeros((0, 6), np.float32)


def unobserved_beside(
    surfels: Surfels, origin_m: np.ndarray, direction: np.ndarray, range_m: np.ndarray
) -> Surfels | None:
    """Unobserved voxels that share a face with a surfel's voxel, as surfels of opacity one half.

    Args:
        surfels: The proven surfaces.
        origin_m: (n, 3) scene-local metres, of all rays, those that end on moving objects included.
        direction: (n, 3) unit, scene-local axes.
        range_m: (n,) metres to the returns.

    Returns:
        Surfels in the middle of their voxels, without hits, passes or planes, each with the intensity of one
        surfel beside it. None where there are none.
    """
    voxel_m = surfels.index.voxel_m
    middle_m, beside = _empty_beside(surfels)
    if len(beside) == 0:
        return None
    index, voxel = index_points(middle_m, voxel_m)
    passes = count_passes(
        np.ascontiguousarray(origin_m, np.float32), np.ascontiguousarray(direction, np.float32),
        range_m.astype(np.float32), index, np.zeros((index.voxel_count, 3), np.float32), _NO_SHAPES,
    )  # fmt: skip
    is_unobserved = passes[voxel] == 0
    if not is_unobserved.any():
        return None
    middle_m, beside = middle_m[is_unobserved], beside[is_unobserved]
    index, voxel = index_points(middle_m, voxel_m)
    each = np.empty(index.voxel_count, np.int64)
    each[voxel] = np.arange(len(voxel))
    none, flat = np.zeros(index.voxel_count, np.int32), np.zeros(index.voxel_count, np.float32)
    return Surfels(
        index=index, mean_m=middle_m[each].astype(np.float32),
        normal=np.zeros((index.voxel_count, 3), np.float32), precision=_NO_SHAPES, thickness_m=flat,
        intensity=surfels.intensity[beside[each]], hits=none, passes=none,
    )  # fmt: skip


def _empty_beside(surfels: Surfels) -> tuple[np.ndarray, np.ndarray]:
    """Middles (n, 3) float64 of the empty voxels beside surfels, and numbers (n,) of those surfels."""
    index = surfels.index
    place = (index.places()[:, None] + _FACES).reshape(-1, 3)
    empty = np.flatnonzero(index.find(place) < 0)
    return index.origin_m + (place[empty] + 0.5) * index.voxel_m, empty // len(_FACES)
