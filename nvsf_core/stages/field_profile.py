"""What a recipe allocates for a scene, and what training it is expected to cost, before it begins."""

import numpy as np

from nvsf_core._types import Scalar
from nvsf_core.evidence.static.surfels import Surfels, candidates_of
from nvsf_core.recipe import Recipe, ResidualRecipe
from nvsf_core.recording.drive import Recording
from nvsf_core.rendering.reproject import NEAR_M
from nvsf_core.stages.profile import motion_in_words
from nvsf_core.stages.residual_model import make_fields
from nvsf_core.stages.training_cost import FITTED_ON, expected_memory_mb, expected_seconds

_SAMPLED_RAYS = 4096


def field_profile(recipe: Recipe, recording: Recording) -> dict[str, Scalar]:
    """Numbers, and `needs` in words; empty for a recipe that takes no size from the scene's evidence.

    Args:
        recipe: To be trained.
        recording: The drive with its evidence.
    """
    if not isinstance(recipe, ResidualRecipe):
        return {}
    fields = make_fields(recipe, recording, 0)
    parameters = {
        sensor: sum(value.numel() for value in model.state_dict().values())
        for sensor, model in (
            ("lidar", fields.lidar), ("camera", fields.camera), ("hits", fields.hits), ("pano", fields.pano),
        )
        if model is not None
    }  # fmt: skip
    found: dict[str, Scalar] = {f"{sensor}_parameters": count for sensor, count in parameters.items()}
    evidence, samples, returns, rays, size = None, 0.0, 0, "", ""
    if recording.lidar is not None and fields.lidar is not None:
        evidence, a = recording.lidar.evidence, recording.lidar.sweeps.arrays
        returns = len(a["range_m"])
        samples = samples_a_ray(
            evidence.standing, a["origin_m"], a["direction"],
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
    seconds = expected_seconds(recipe, parameters, samples)
    memory_mb = expected_memory_mb(recipe, parameters, returns)
    millions = sum(parameters.values()) / 1e6
    return found | {
        "expected_seconds": seconds,
        "expected_memory_mb": memory_mb,
        "needs": f"{motion_in_words(evidence)}; {millions:.1f} M parameters{size}{rays}; about "
        f"{_in_words(seconds)} and {memory_mb / 1000:.1f} GB to train (estimate for {FITTED_ON})",
    }


def samples_a_ray(
    surfels: Surfels, origin_m: np.ndarray, direction: np.ndarray, *, most: int, far_m: float
) -> float:
    """Mean surfaces that a LiDAR ray looks at, over an even choice of the rays (n, 3), scene-local."""
    chosen = np.unique(np.linspace(0, len(origin_m) - 1, _SAMPLED_RAYS).astype(np.int64))
    found = candidates_of(surfels, origin_m[chosen], direction[chosen], most=most, near_m=NEAR_M, far_m=far_m)
    return float((found.voxel >= 0).sum(axis=1).mean())


def _in_words(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120.0 else f"{seconds / 60.0:.0f} minutes"
