"""What a residual recipe allocates for a scene, before it is trained."""

import numpy as np

from nvsf_core._types import Scalar
from nvsf_core.evidence.profile import motion_in_words
from nvsf_core.evidence.static.surfels import Surfels, candidates_of
from nvsf_core.models.residual.render import make_fields
from nvsf_core.recipe import ResidualRecipe
from nvsf_core.recording.drive import Recording
from nvsf_core.rendering.reproject import NEAR_M

_SAMPLED_RAYS = 4096


def needs(recipe: ResidualRecipe, recording: Recording) -> dict[str, Scalar]:
    """Numbers, and `needs` in words.

    Args:
        recipe: To be trained.
        recording: The drive with its evidence.
    """
    fields = make_fields(recipe, recording, 0)
    parameters = {
        sensor: sum(value.numel() for value in model.state_dict().values())
        for sensor, model in (
            ("lidar", fields.lidar), ("camera", fields.camera), ("hits", fields.hits), ("pano", fields.pano),
        )
        if model is not None
    }  # fmt: skip
    found: dict[str, Scalar] = {f"{sensor}_parameters": count for sensor, count in parameters.items()}
    evidence, rays, size = None, "", ""
    if recording.lidar is not None and fields.lidar is not None:
        evidence, a = recording.lidar.evidence, recording.lidar.sweeps.arrays
        samples = samples_a_ray(
            evidence.static, a["origin_m"], a["direction"],
            most=recipe.evidence.lidar_candidates, far_m=recording.lidar.far_m,
        )  # fmt: skip
        layout = fields.lidar.grid.layout
        finest_m = fields.lidar.bounds.edge_m / layout.finest_resolution
        rays = f"; {samples:.0f} samples a ray"
        size = f" in {layout.levels} levels down to {100 * finest_m:.0f} cm"
        found |= {
            "hash_levels": layout.levels,
            "hash_entries": layout.entries,
            "finest_cell_m": finest_m,
            "samples_a_ray": samples,
        }
    millions = sum(parameters.values()) / 1e6
    words = f"{motion_in_words(evidence)}; {millions:.1f} M parameters{size}{rays}"
    return found | {"needs": words}


def samples_a_ray(
    surfels: Surfels, origin_m: np.ndarray, direction: np.ndarray, *, most: int, far_m: float
) -> float:
    """Mean surfaces that a LiDAR ray looks at, over an even choice of the rays (n, 3), scene-local."""
    chosen = np.unique(np.linspace(0, len(origin_m) - 1, _SAMPLED_RAYS).astype(np.int64))
    found = candidates_of(surfels, origin_m[chosen], direction[chosen], most=most, near_m=NEAR_M, far_m=far_m)
    return float((found.voxel >= 0).sum(axis=1).mean())
