"""The training-free LiDAR: surfels composited along the ray, hits by the vote of the nearest scans."""

import numpy as np
import torch

from nvsf_core.errors import ShapeError
from nvsf_core.evidence.moving.objects import ObjectSurfels, candidates_on, merge_objects
from nvsf_core.evidence.static.surfels import (
    Candidates,
    Surfels,
    candidates_of,
)
from nvsf_core.kernels.surfel_rendering import render_by_surfels
from nvsf_core.rendering.rendered import RenderedRays
from nvsf_core.rendering.weights import weighted_median_index

NEAR_M = 0.9
"""Nothing is recorded nearer to the sensor, but for the own vehicle, which is put back by itself."""


def reproject_rays(
    surfels: Surfels,
    origin_m: np.ndarray,
    direction: np.ndarray,
    hit_prior: np.ndarray,
    *,
    most: int,
    far_m: float,
    objects: tuple[ObjectSurfels, ...] = (),
    time_s: np.ndarray | None = None,
) -> RenderedRays:
    """Answer rays (r, 3), scene-local, from evidence alone.

    The range is the weighted median candidate's; `hit_prior` (r,) is the prior's share of returns and becomes
    the hit probability wherever there is a candidate at all. Moving objects are where they are at the
    rays' times `time_s` (r,), which must be given with them.
    """
    rendered = _answers_of_what_stands(surfels, origin_m, direction, hit_prior, most=most, far_m=far_m)
    if not objects:
        return rendered
    if time_s is None:
        raise ShapeError("expected the rays' times with moving objects, found none; pass time_s")
    met = [candidates_on(one, origin_m, direction, time_s, near_m=NEAR_M, far_m=far_m) for one in objects]
    rays = np.unique(np.concatenate([ray for ray, _ in met]))
    if len(rays) > 0:
        found = candidates_of(surfels, origin_m[rays], direction[rays], most=most, near_m=NEAR_M, far_m=far_m)
        found = merge_objects(found, rays, surfels.index.voxel_count, objects, met)
        own_votes = [
            (np.searchsorted(rays, ray), one.hit_prior(own, origin_m[ray], direction[ray], time_s[ray]))
            for one, (ray, own) in zip(objects, met, strict=True)
        ]
        for name, value in _answers_with_objects(surfels, found, hit_prior[rays], objects, own_votes).items():
            getattr(rendered, name)[rays] = value
    return rendered


def _answers_of_what_stands(
    surfels: Surfels,
    origin_m: np.ndarray,
    direction: np.ndarray,
    hit_prior: np.ndarray,
    *,
    most: int,
    far_m: float,
) -> RenderedRays:
    range_m, intensity = render_by_surfels(
        np.ascontiguousarray(origin_m, np.float32),
        np.ascontiguousarray(direction, np.float32),
        surfels.index,
        surfels.surfaces,
        surfels.walk_limits(NEAR_M, far_m, most),
    )
    hit = np.where(np.isfinite(range_m), hit_prior, 0.0).astype(np.float32)
    return RenderedRays(range_m=range_m, hit=hit, intensity=intensity)


def _answers_with_objects(
    surfels: Surfels,
    found: Candidates,
    hit_prior: np.ndarray,
    objects: tuple[ObjectSurfels, ...],
    own_votes: list[tuple[np.ndarray, np.ndarray]],
) -> dict[str, np.ndarray]:
    """The same three answers of rays (m,) whose candidates are the objects' too; each has at least one.

    `own_votes` are of each object: rays (k,) int64 of the m that met it, and their votes (k,).
    """
    shine = np.concatenate([surfels.intensity, *(one.surfels.intensity for one in objects)])
    weights = found.weights
    chosen = weighted_median_index(torch.from_numpy(weights)).numpy()
    return {
        "range_m": found.range_m[np.arange(len(weights)), chosen],
        "hit": _votes_with_objects(surfels, found, hit_prior, objects, own_votes),
        "intensity": (weights * shine[found.voxel]).sum(axis=1) / weights.sum(axis=1),
    }


def _votes_with_objects(
    surfels: Surfels,
    found: Candidates,
    hit_prior: np.ndarray,
    objects: tuple[ObjectSurfels, ...],
    own_votes: list[tuple[np.ndarray, np.ndarray]],
) -> np.ndarray:
    """Votes (r,) where rays that end on objects, by more than half, ask those; arguments as above."""
    weights, first = found.weights, surfels.index.voxel_count
    on_objects, own = np.zeros(len(hit_prior)), np.zeros(len(hit_prior))
    for one, (rays, share) in zip(objects, own_votes, strict=True):
        is_its = (found.voxel[rays] >= first) & (found.voxel[rays] < first + one.surfels.index.voxel_count)
        on_it = np.where(is_its, weights[rays], 0.0).sum(axis=1)
        on_objects[rays] += on_it
        own[rays] += on_it * share
        first += one.surfels.index.voxel_count
    asked: np.ndarray = hit_prior.copy()
    rows = np.flatnonzero(on_objects > 0.5 * weights.sum(axis=1))
    asked[rows] = own[rows] / on_objects[rows]
    return asked
