"""Surfels from images, for places where no laser looked: several views must agree on a depth there."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nvsf_core.evidence.surfels import Surfels, build_surfels

_VOXEL_M = 0.4
_LEAST_VIEWS = 3
"""Fewest views that must have a depth in a voxel. Wrong depths, above all in the sky, rarely agree."""


@dataclass(frozen=True, slots=True, eq=False)
class DepthRays:
    """Some pixels of one view, as rays with a depth."""

    origin_m: np.ndarray
    """(3,) float32 scene-local, metres."""
    direction: np.ndarray
    """(n, 3) float32 unit, scene-local axes."""
    range_m: np.ndarray
    """(n,) float32 metres; infinite where nothing nearer than the sky was found."""


def image_surfels(views: Sequence[DepthRays], *, far_m: float, intensity: float) -> Surfels | None:
    """Surfels nearer than `far_m` (metres) on which at least three views agree; None where there are none.

    Like a LiDAR ray, each pixel's ray counts as passing through the voxels before its end: a place that most
    views look through hardly stops a ray. Images do not measure LiDAR intensity: all surfels get `intensity`.
    """
    lengths = [len(view.range_m) for view in views]
    if sum(lengths) == 0:
        return None
    origin_m = np.repeat([view.origin_m for view in views], lengths, axis=0).astype(np.float32)
    direction = np.concatenate([view.direction for view in views])
    range_m = np.concatenate([view.range_m for view in views])
    is_near = range_m < far_m
    point_m = origin_m[is_near] + direction[is_near] * range_m[is_near, None]
    is_surface = is_near.copy()
    is_surface[is_near] = (
        _views_there(point_m, np.repeat(np.arange(len(views)), lengths)[is_near]) >= _LEAST_VIEWS
    )
    if not is_surface.any():
        return None
    shine = np.full(len(range_m), intensity, np.float32)
    return build_surfels(
        origin_m, direction, np.minimum(range_m, far_m).astype(np.float32), shine,
        voxel_m=_VOXEL_M, is_surface=is_surface,
    )  # fmt: skip


def _views_there(point_m: np.ndarray, view: np.ndarray) -> np.ndarray:
    """(n,) int64: number of views with a point in each point's voxel; points (n, 3), their views (n,)."""
    if len(point_m) == 0:
        return np.zeros(0, np.int64)
    cell = np.floor(point_m / _VOXEL_M).astype(np.int64)
    cell -= cell.min(axis=0)
    _, voxel = np.unique(np.ravel_multi_index(cell.T, cell.max(axis=0) + 1), return_inverse=True)
    pairs = np.unique(voxel * (view.max() + 1) + view)
    return np.bincount(pairs // (view.max() + 1))[voxel]
