"""The training-free LiDAR: surfels composited along the ray, hits by the vote of the nearest scans."""

import numpy as np
import torch

from nvsf_core.errors import ShapeError
from nvsf_core.evidence.objects import ObjectSurfels, add_objects
from nvsf_core.evidence.surfels import Candidates, Surfels, candidates_of
from nvsf_core.rendering.accumulate import weighted_median_index
from nvsf_core.rendering.answers import RayAnswers

NEAR_M = 0.9
"""Nothing is recorded nearer to the sensor, but for the own vehicle, which is put back by itself."""


def composite(candidates: Candidates) -> np.ndarray:
    """Weights (r, k) float32 of a ray's candidates: w_i = a_i * prod_{j<i} (1 - a_j)."""
    light = np.cumprod(1.0 - candidates.opacity, axis=1)
    before = np.concatenate([np.ones_like(light[:, :1]), light[:, :-1]], axis=1)
    return np.asarray(candidates.opacity * before)


def reproject_rays(
    surfels: Surfels,
    origin_m: np.ndarray,
    direction: np.ndarray,
    vote: np.ndarray,
    *,
    most: int,
    far_m: float,
    objects: tuple[ObjectSurfels, ...] = (),
    time_s: np.ndarray | None = None,
) -> RayAnswers:
    """Answer rays (r, 3), scene-local, from evidence alone.

    The range is the weighted median candidate's; `vote` (r,) is the prior's share of returns and becomes
    the hit probability wherever there is a candidate at all. Moving objects are where they are at the
    rays' times `time_s` (r,), which must be given with them.
    """
    candidates = candidates_of(surfels, origin_m, direction, most=most, near_m=NEAR_M, far_m=far_m)
    shine = surfels.intensity
    if objects:
        if time_s is None:
            raise ShapeError("expected the rays' times with moving objects, found none; pass time_s")
        shine = np.concatenate([shine, *(one.surfels.intensity for one in objects)])
        candidates = add_objects(
            candidates, surfels.index.count, objects, origin_m, direction, time_s, near_m=NEAR_M, far_m=far_m
        )
    weights = composite(candidates)
    if objects:
        vote = _votes_with_objects(vote, weights, candidates.voxel - surfels.index.count, objects)
    rows = np.arange(len(weights))
    answered = candidates.voxel[:, 0] >= 0
    chosen = weighted_median_index(torch.from_numpy(weights)).numpy()
    total = weights.sum(axis=1)
    intensity = (weights * shine[candidates.voxel]).sum(axis=1) / np.where(answered, total, 1.0)
    return RayAnswers(
        range_m=np.where(answered, candidates.range_m[rows, chosen], np.inf).astype(np.float32),
        hit=np.where(answered, vote, 0.0).astype(np.float32),
        intensity=np.where(answered, intensity, 0.0).astype(np.float32),
    )


def _votes_with_objects(
    vote: np.ndarray, weights: np.ndarray, voxel: np.ndarray, objects: tuple[ObjectSurfels, ...]
) -> np.ndarray:
    """Votes (r,) where rays that end on an object, by more than half, ask the object's surfels.

    `voxel` (r, k) counts the objects' voxels from 0; the background's are negative.
    """
    own = np.where(voxel >= 0, weights, 0.0)
    on_object = own.sum(axis=1)
    rows = np.flatnonzero(on_object > 0.5 * weights.sum(axis=1))
    share = np.concatenate([one.vote for one in objects])
    asked = vote.copy()
    asked[rows] = (own[rows] * share[np.maximum(voxel[rows], 0)]).sum(axis=1) / on_object[rows]
    return asked
