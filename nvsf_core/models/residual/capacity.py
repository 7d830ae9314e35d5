"""The learned parts of a scene's model, and the sizes that the scene needs."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor, nn

from nvsf_core._types import Scalar
from nvsf_core.evidence.profile import motion_in_words, point_spacing_m, surface_m2
from nvsf_core.evidence.surfels import Surfels, candidates_of
from nvsf_core.fields.camera_networks import CameraEnsemble
from nvsf_core.fields.cell_network import CellNetwork
from nvsf_core.fields.lidar_field import LidarField
from nvsf_core.models.residual.pano_neighbours import FEATURES as PANO_FEATURES
from nvsf_core.models.residual.pano_neighbours import PARTS
from nvsf_core.models.residual.raydrop_grid import FEATURES as HITS_FEATURES
from nvsf_core.recipe import FieldSpec, HitsSpec, PanoSpec, ResidualRecipe
from nvsf_core.recording.drive import Recording
from nvsf_core.rendering.reproject import NEAR_M

_SPACINGS_A_CELL = 2.5
"""Edge of the finest cell in mean distances between returns; finer cells hold too few to learn from."""
_CELLS_AN_ENTRY = 4.0
"""Cells of the finest level on a surface for each entry of the hash table."""
_MOST_GROWTH = 1.9
"""Largest ratio of the cells of neighbouring levels."""
_SMALLEST_LOG2 = 10
_SAMPLED_RAYS = 4096


def needed_field(most: FieldSpec, surfels: Surfels) -> FieldSpec:
    """The recipe's field, or a smaller one if the scene needs no more.

    finest cell = max(recipe's, 2.5 mean distances between returns); entries a level = surface /
    (4 finest cell^2), rounded to a power of two; levels = as many as keep the cells of neighbouring levels
    within a factor of 1.9. No number exceeds the recipe's.

    Args:
        most: The recipe's field.
        surfels: Of all returns.
    """
    finest_m = max(most.finest_cell_m, _SPACINGS_A_CELL * point_spacing_m(surfels))
    finest_m = min(finest_m, most.coarsest_cell_m)
    entries = surface_m2(surfels) / (_CELLS_AN_ENTRY * finest_m**2)
    log2_table = max(_SMALLEST_LOG2, round(math.log2(max(1.0, entries))))
    levels = 1 + math.ceil(math.log(most.coarsest_cell_m / finest_m) / math.log(_MOST_GROWTH))
    return replace(
        most,
        finest_cell_m=finest_m,
        log2_table=min(most.log2_table, log2_table),
        levels=min(most.levels, levels),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class ResidualFields:
    """The learned parts of one scene's model."""

    lidar: LidarField | None
    """None where the drive has no LiDAR."""
    camera: CameraEnsemble | None
    """None where the drive has no camera."""
    hits: CellNetwork | None = None
    """The raydrop network; None where the recipe has none."""
    pano: CellNetwork | None = None
    """Corrects panos; None where the recipe has none."""

    def models(self) -> dict[str, nn.Module]:
        """The parts that there are, by name."""
        found = {"lidar": self.lidar, "camera": self.camera, "hits": self.hits, "pano": self.pano}
        return {part: model for part, model in found.items() if model is not None}

    def tensors(self) -> dict[str, Tensor]:
        """All weights on the CPU, named `<part>.<weight>`."""
        return {
            f"{part}.{name}": value.cpu()
            for part, model in self.models().items()
            for name, value in model.state_dict().items()
        }


def make_fields(recipe: ResidualRecipe, recording: Recording, seed: int) -> ResidualFields:
    """Untrained parts of the size that the scene needs, each with weights from its own seed."""
    lidar = camera = hits = pano = None
    if recording.lidar is not None:
        if recipe.hits is not None:
            hits = hits_network(recipe.hits, torch.Generator().manual_seed(seed + 3))
        if recipe.pano is not None and recipe.pano.training is not None:
            pano = pano_network(recipe.pano, torch.Generator().manual_seed(seed + 2))
        surfels = recording.lidar.evidence.surfels
        spec = needed_field(recipe.lidar_field, surfels)
        lidar = LidarField.around(surfels.mean_m, spec, torch.Generator().manual_seed(seed))
    if recording.cameras:
        camera = CameraEnsemble(recipe.camera, torch.Generator().manual_seed(seed + 1))
    return ResidualFields(lidar=lidar, camera=camera, hits=hits, pano=pano)


def hits_network(spec: HitsSpec, generator: torch.Generator) -> CellNetwork:
    """The untrained raydrop network, with weights from `generator`."""
    return CellNetwork(HITS_FEATURES, 1, generator, channels=spec.channels, layers=spec.layers)


def pano_network(spec: PanoSpec, generator: torch.Generator) -> CellNetwork:
    """The untrained network that corrects panos, with weights from `generator`."""
    return CellNetwork(PANO_FEATURES, len(PARTS), generator, channels=spec.channels, layers=spec.layers)


def needs(fields: ResidualFields, recipe: ResidualRecipe, recording: Recording) -> dict[str, Scalar]:
    """The sizes of a scene's model as numbers, and in words under `needs`."""
    parameters = {
        part: sum(value.numel() for value in model.state_dict().values())
        for part, model in fields.models().items()
    }
    found: dict[str, Scalar] = {f"{part}_parameters": count for part, count in parameters.items()}
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
    """Mean number of surfaces that a LiDAR ray is rendered from, over 4096 evenly chosen rays.

    Args:
        surfels: Of the static scene.
        origin_m: (n, 3) scene-local.
        direction: (n, 3) unit.
        most: Surfaces a ray at most.
        far_m: How far a ray is followed.
    """
    chosen = np.unique(np.linspace(0, len(origin_m) - 1, _SAMPLED_RAYS).astype(np.int64))
    found = candidates_of(surfels, origin_m[chosen], direction[chosen], most=most, near_m=NEAR_M, far_m=far_m)
    return float((found.voxel >= 0).sum(axis=1).mean())
