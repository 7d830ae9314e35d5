"""Renderers of LiDAR rays: by a trained field, by LiDAR evidence alone, by surfels from images."""

from dataclasses import fields
from typing import Any

import numpy as np
import torch

from nvsf_core.evidence.moving.objects import NearObjects
from nvsf_core.evidence.surfels import Surfels, candidates_of
from nvsf_core.fields.lidar_field import LidarField, object_surfaces, surface_batch
from nvsf_core.kernels.threads import in_parts
from nvsf_core.recipe.residual import EvidenceSpec
from nvsf_core.recording.drive import LidarRecording
from nvsf_core.rendering.lidar import render_rays
from nvsf_core.rendering.rendered import RenderedRays
from nvsf_core.rendering.reproject import NEAR_M, reproject_rays
from nvsf_core.simulation.scene_model import RayRenderer

_CHUNK_RAYS = 262144
_FIELD_RAYS = 8192
"""Rays that the field renders at once: few enough that its intermediate values fit into the CPU's caches."""


def field_renderer(
    field: LidarField, surfels: Surfels, moving: NearObjects | None, *, most: int, far_m: float
) -> RayRenderer:
    """Renderer by a trained field, which corrects the static surfels and those of each moving object.

    Args:
        field: Trained.
        surfels: Static surfels.
        moving: The scene's moving objects; None = nothing moves.
        most: Most candidate surfels a ray.
        far_m: A ray ends here.
    """
    places = None if moving is None else field.places(moving.evidence)

    def render(
        origin_m: np.ndarray, direction: np.ndarray, hit_prior: np.ndarray, time_s: np.ndarray
    ) -> RenderedRays:
        objects = None
        if moving is not None and places is not None:
            there = moving.at(time_s, origin_m)
            objects = object_surfaces(there, places, origin_m, direction, time_s, near_m=NEAR_M, far_m=far_m)
        parts = _parts(len(hit_prior), _FIELD_RAYS)

        def rendered(number: int) -> RenderedRays:
            part = parts[number]
            met = None if objects is None else objects.of(np.arange(part.start, part.stop))
            batch = surface_batch(
                surfels, origin_m[part], direction[part], most=most, near_m=NEAR_M, far_m=far_m, objects=met
            )
            return render_rays(field, batch, torch.from_numpy(hit_prior[part]))

        return _joined(in_parts(rendered, len(parts)))

    return render


def evidence_renderer(
    surfels: Surfels, moving: NearObjects | None, *, most: int, far_m: float
) -> RayRenderer:
    """Renderer by evidence alone: static surfels, and each moving object where it is at a ray's time.

    Arguments as of `field_renderer`.
    """

    def render(
        origin_m: np.ndarray, direction: np.ndarray, hit_prior: np.ndarray, time_s: np.ndarray
    ) -> RenderedRays:
        objects = () if moving is None else moving.at(time_s, origin_m)
        return reproject_rays(
            surfels, origin_m, direction, hit_prior, most=most, far_m=far_m, objects=objects, time_s=time_s
        )

    return render


def reprojecting_renderer(lidar: LidarRecording) -> RayRenderer:
    """Renderer by all LiDAR evidence of a drive: what `reproject` shows, which a field must beat."""
    return evidence_renderer(
        lidar.evidence.for_rendering, lidar.moving(), most=EvidenceSpec().lidar_candidates, far_m=lidar.far_m
    )


def image_renderer(surfels: Surfels, *, most: int, far_m: float) -> RayRenderer:
    """Renderer by surfels from images; a ray's total weight is its hit probability.

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
    """Render any number of rays in bounded memory.

    Args:
        render: Renders up to some hundred thousand rays at once.
        origin_m: (r, 3) float32 scene-local, metres.
        direction: (r, 3) float32 unit, scene-local axes.
        hit_prior: (r,) float32, 0..1, see `RayRenderer`.
        time_s: (r,) float64 seconds since the first frame.
    """
    rays = (origin_m, direction, hit_prior, time_s)
    return _joined(
        [render(*(column[part] for column in rays)) for part in _parts(len(hit_prior), _CHUNK_RAYS)]
    )


def _parts(rays: int, most: int) -> list[slice]:
    """Slices of at most `most` rays each; at least one, which may be empty."""
    return [slice(i, min(i + most, rays)) for i in range(0, max(1, rays), most)]


def _joined(parts: list[RenderedRays]) -> RenderedRays:
    """Concatenation of parts; without a column that any part lacks."""
    if len(parts) == 1:
        return parts[0]

    def column(name: str) -> Any:
        found = [getattr(part, name) for part in parts]
        return None if any(one is None for one in found) else np.concatenate(found)

    return RenderedRays(*(column(one.name) for one in fields(RenderedRays)))
