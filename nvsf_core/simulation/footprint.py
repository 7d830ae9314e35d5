"""Beams with a width: five rays each, of which the strongest return counts, as a LiDAR in that mode reports.

A beam's light falls off from its axis to its edge as a Gaussian; its ray along the axis carries half of what
is counted here, and four rays at half of the half angle an eighth each. Rays that end within 0.5 m of each
other make one return: a part of the light comes back as probably as all of it, only less bright.
"""

import numpy as np

from nvsf_core.rendering.rendered import RenderedRays
from nvsf_core.simulation.ray_renderers import render_in_chunks
from nvsf_core.simulation.scene_model import RayRenderer

_SHARES = np.array([0.5, 0.125, 0.125, 0.125, 0.125], np.float32)
_SAME_RETURN_M = 0.5
_LEAST_SHINE = np.float32(1e-3)
"""Of a drive without intensities all is 0: what ends somewhere is still stronger than what does not."""


# Wide: four of them are columns of the rays.
def render_beams(
    render: RayRenderer,
    origin_m: np.ndarray,
    direction: np.ndarray,
    hit_prior: np.ndarray,
    time_s: np.ndarray,
    *,
    divergence_mrad: float,
) -> RenderedRays:
    """Render rays as beams.

    Args:
        render: Renders rays without width.
        origin_m: (r, 3) float32 scene-local, metres.
        direction: (r, 3) float32 unit, scene-local axes.
        hit_prior: (r,) float32, 0..1.
        time_s: (r,) float64 seconds since the first frame.
        divergence_mrad: Full angle of a beam.

    Returns:
        Range of the strongest return (mean of its rays, metres), its hit probability (likewise), and its
        intensity, the sum of its rays' shares; what else is known of a ray is that of the beam's axis.
    """
    parts = [
        render_in_chunks(render, origin_m, one, hit_prior, time_s)
        for one in _directions(direction, divergence_mrad)
    ]
    range_m, hit, shine = (
        np.stack([getattr(part, name) for part in parts]) for name in ("range_m", "hit", "intensity")
    )
    known = np.isfinite(range_m)
    weight = np.where(known, hit, 0.0) * _SHARES[:, None]
    far_m = np.where(known, range_m, 0.0)
    # Of each ray the energy of all that end where it ends; the strongest of these groups returns.
    same = known[:, None] & known[None] & (np.abs(far_m[:, None] - far_m[None]) < _SAME_RETURN_M)
    energy = (same * (weight * np.maximum(shine, _LEAST_SHINE))[None]).sum(axis=1)
    best = energy.argmax(axis=0)
    chosen = np.take_along_axis(same, best[None, None], axis=0)[0]
    group = chosen * weight
    total = group.sum(axis=0)
    safe = np.maximum(total, 1e-12)
    found_m = np.where(total > 0.0, (group * far_m).sum(axis=0) / safe, np.inf)
    return RenderedRays(
        range_m=found_m.astype(np.float32),
        hit=np.clip(total / np.maximum((chosen * _SHARES[:, None]).sum(axis=0), 1e-12), 0.0, 1.0).astype(
            np.float32
        ),
        intensity=(chosen * _SHARES[:, None] * shine).sum(axis=0).astype(np.float32),
        hit_prior=parts[0].hit_prior,
        on_object=parts[0].on_object,
    )


def _directions(direction: np.ndarray, divergence_mrad: float) -> list[np.ndarray]:
    """The axis and four rays around it, each (r, 3) float32 unit, a quarter of the full angle away."""
    up = np.zeros_like(direction)
    # Not parallel to the ray: the axis along which it has the least.
    up[np.arange(len(up)), np.abs(direction).argmin(axis=1)] = 1.0
    across = np.cross(direction, up)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along = np.cross(across, direction)
    step = np.float32(divergence_mrad * 1e-3 / 4.0)
    around = [direction + step * sign * axis for axis in (across, along) for sign in (-1.0, 1.0)]
    return [
        direction,
        *((one / np.linalg.norm(one, axis=1, keepdims=True)).astype(np.float32) for one in around),
    ]
