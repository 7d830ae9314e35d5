"""Renderers of LiDAR rays: by a trained field, by evidence alone, by what images prove."""

import numpy as np
import torch

from nvsf_core.evidence.moving.objects import NearObjects
from nvsf_core.evidence.static.surfels import Surfels, candidates_of
from nvsf_core.fields.lidar_field import LidarField
from nvsf_core.fields.surface_batch import object_surfaces, surface_batch
from nvsf_core.rendering.lidar import render_rays
from nvsf_core.rendering.rendered import RenderedRays
from nvsf_core.rendering.reproject import NEAR_M, reproject_rays
from nvsf_core.simulation.scene_model import RayRenderer

_CHUNK_RAYS = 262144
_FIELD_RAYS = 8192
"""Rays that the field answers at once: what it computes of them stays in the caches."""


def field_renderer(
    field: LidarField, surfels: Surfels, moving: NearObjects | None, *, most: int, far_m: float
) -> RayRenderer:
    """Answers by the trained field: corrections of what stays, and of each object in its own frame.

    Args:
        field: Trained.
        surfels: Of what stays.
        moving: The scene's moving objects; None where nothing moves, and nobody is asked about motion.
        most: Candidates a ray.
        far_m: How far a ray is followed.
    """
    places = None if moving is None else field.places(moving.evidence)

    def render(
        origin_m: np.ndarray, direction: np.ndarray, hit_prior: np.ndarray, time_s: np.ndarray
    ) -> RenderedRays:
        objects = None
        if moving is not None and places is not None:
            there = moving.at(time_s)
            objects = object_surfaces(there, places, origin_m, direction, time_s, near_m=NEAR_M, far_m=far_m)
        parts = []
        for part in _parts(len(hit_prior), _FIELD_RAYS):
            met = None if objects is None else objects.of(np.arange(part.start, part.stop))
            batch = surface_batch(
                surfels, origin_m[part], direction[part], most=most, near_m=NEAR_M, far_m=far_m, objects=met
            )
            parts.append(render_rays(field, batch, torch.from_numpy(hit_prior[part])))
        return _joined(parts)

    return render


def evidence_renderer(
    surfels: Surfels, moving: NearObjects | None, *, most: int, far_m: float
) -> RayRenderer:
    """Answers by evidence alone: what stays, and each moving object where it is at a ray's time.

    Arguments as of `field_renderer`.
    """

    def render(
        origin_m: np.ndarray, direction: np.ndarray, hit_prior: np.ndarray, time_s: np.ndarray
    ) -> RenderedRays:
        objects = () if moving is None else moving.at(time_s)
        return reproject_rays(
            surfels, origin_m, direction, hit_prior, most=most, far_m=far_m, objects=objects, time_s=time_s
        )

    return render


def image_renderer(surfels: Surfels, *, most: int, far_m: float) -> RayRenderer:
    """Answers by what images prove; how far a ray is stopped is its hit probability.

    Arguments as of `field_renderer`.
    """

    def render(
        origin_m: np.ndarray, direction: np.ndarray, hit_prior: np.ndarray, time_s: np.ndarray
    ) -> RenderedRays:
        found = candidates_of(surfels, origin_m, direction, most=most, near_m=NEAR_M, far_m=far_m)
        stopped = found.weights.sum(axis=1)
        return reproject_rays(surfels, origin_m, direction, stopped, most=most, far_m=far_m)

    return render


def render_in_chunks(
    render: RayRenderer,
    origin_m: np.ndarray,
    direction: np.ndarray,
    hit_prior: np.ndarray,
    time_s: np.ndarray,
) -> RenderedRays:
    """Answer any number of rays in bounded memory."""
    rays = (origin_m, direction, hit_prior, time_s)
    return _joined(
        [render(*(column[part] for column in rays)) for part in _parts(len(hit_prior), _CHUNK_RAYS)]
    )


def _parts(rays: int, most: int) -> list[slice]:
    """Consecutive parts of so many rays; one, though empty, of none."""
    return [slice(i, min(i + most, rays)) for i in range(0, max(1, rays), most)]


def _joined(parts: list[RenderedRays]) -> RenderedRays:
    if len(parts) == 1:
        return parts[0]
    hit_priors = [part.hit_prior for part in parts if part.hit_prior is not None]
    range_m, hit, intensity = (
        np.concatenate([getattr(p, n) for p in parts]) for n in ("range_m", "hit", "intensity")
    )
    hit_prior = np.concatenate(hit_priors) if len(hit_priors) == len(parts) else None
    return RenderedRays(range_m, hit, intensity, hit_prior)
