"""LiDAR rendering without training: surfels composited along each ray; hits from the hit prior."""

import numpy as np

from nvsf_core.errors import ShapeError
from nvsf_core.evidence.moving.objects import ObjectSurfels, candidates_on, merge_objects
from nvsf_core.evidence.surfels import Candidates, Surfels, candidates_of, weighted_median_index
from nvsf_core.kernels.surfel_rendering import render_by_surfels
from nvsf_core.rendering.rendered import RenderedRays

NEAR_M = 0.9
"""Nothing is recorded nearer to the sensor except the own vehicle, which is added separately."""


# Wide: four are columns of the rays, the others independent of each other.
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
    """Render rays from evidence alone.

    The range is that of the weighted median candidate. The hit probability is the hit prior where the ray
    meets any surfel, else 0.

    Args:
        surfels: Static surfels.
        origin_m: (r, 3) scene-local, metres.
        direction: (r, 3) unit, scene-local axes.
        hit_prior: (r,) 0..1, share of the nearest training scans that returned here. A ray that ends on a
            moving object uses the object's own hit prior instead.
        most: Most candidate surfels a ray.
        far_m: A ray ends here.
        objects: Moving objects; each is where it is at a ray's time.
        time_s: (r,) seconds since the first frame, when each ray is fired; needed with objects.

    Raises:
        ShapeError: There are objects but no times.
    """
    rendered = _render_static(surfels, origin_m, direction, hit_prior, most=most, far_m=far_m)
    if not objects:
        return rendered
    if time_s is None:
        raise ShapeError("expected the rays' times with moving objects, found none; pass time_s")
    met = [candidates_on(one, origin_m, direction, time_s, near_m=NEAR_M, far_m=far_m) for one in objects]
    rays = np.unique(np.concatenate([ray for ray, _ in met]))
    if len(rays) > 0:
        found = candidates_of(surfels, origin_m[rays], direction[rays], most=most, near_m=NEAR_M, far_m=far_m)
        found = merge_objects(found, rays, surfels.count, objects, met)
        own_priors = [
            (np.searchsorted(rays, ray), one.hit_prior(own, origin_m[ray], direction[ray], time_s[ray]))
            for one, (ray, own) in zip(objects, met, strict=True)
        ]
        weights = found.weights
        chosen = weighted_median_index(weights)
        shine = np.concatenate([surfels.intensity, *(one.surfels.intensity for one in objects)])
        rendered.range_m[rays] = found.range_m[np.arange(len(weights)), chosen]
        rendered.hit[rays] = _prior_with_objects(surfels, found, hit_prior[rays], objects, own_priors)
        rendered.intensity[rays] = (weights * shine[found.voxel]).sum(axis=1) / weights.sum(axis=1)
    return rendered


def _render_static(
    surfels: Surfels,
    origin_m: np.ndarray,
    direction: np.ndarray,
    hit_prior: np.ndarray,
    *,
    most: int,
    far_m: float,
) -> RenderedRays:
    """Arguments and result as of `reproject_rays`, without moving objects."""
    range_m, intensity = render_by_surfels(
        np.ascontiguousarray(origin_m, np.float32),
        np.ascontiguousarray(direction, np.float32),
        surfels.index,
        surfels.surfaces,
        surfels.walk_limits(NEAR_M, far_m, most),
    )
    hit = np.where(np.isfinite(range_m), hit_prior, 0.0).astype(np.float32)
    return RenderedRays(range_m=range_m, hit=hit, intensity=intensity)


def _prior_with_objects(
    surfels: Surfels,
    found: Candidates,
    hit_prior: np.ndarray,
    objects: tuple[ObjectSurfels, ...],
    own_priors: list[tuple[np.ndarray, np.ndarray]],
) -> np.ndarray:
    """Hit prior (m,) of rays that meet objects: the objects' own where they have over half of the weight.

    `own_priors` are, for each object, the indices (k,) of the rays that meet it, and its hit prior (k,).
    """
    weights, first = found.weights, surfels.count
    on_objects, own = np.zeros(len(hit_prior)), np.zeros(len(hit_prior))
    for one, (rays, share) in zip(objects, own_priors, strict=True):
        is_its = (found.voxel[rays] >= first) & (found.voxel[rays] < first + one.surfels.count)
        on_it = np.where(is_its, weights[rays], 0.0).sum(axis=1)
        on_objects[rays] += on_it
        own[rays] += on_it * share
        first += one.surfels.count
    mixed: np.ndarray = hit_prior.copy()
    rows = np.flatnonzero(on_objects > 0.5 * weights.sum(axis=1))
    mixed[rows] = own[rows] / on_objects[rows]
    return mixed
