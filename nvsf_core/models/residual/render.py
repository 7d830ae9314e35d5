"""The residual recipes: small fields that correct what the LiDAR proves, or replace what it lacks."""

from dataclasses import dataclass

import torch
from torch import Tensor

from nvsf_core.fields.camera_networks import CameraEnsemble
from nvsf_core.fields.cell_network import CellNetwork
from nvsf_core.fields.lidar_field import LidarField
from nvsf_core.geometry.bounds import Bounds
from nvsf_core.models.baselines.reproject import carrying_renderer, unknown_renderer
from nvsf_core.models.family import Weights
from nvsf_core.models.residual.camera import ALIGNED, LEARNED, camera_renderer
from nvsf_core.models.residual.capacity import needed_field
from nvsf_core.models.residual.lidar import SHOWS_FIELD
from nvsf_core.models.residual.pano import CORRECTED, pano_renderer
from nvsf_core.models.residual.pose_refinement import corrections_from
from nvsf_core.models.residual.raydrop import HITS_BLEND, turn_hits
from nvsf_core.recipe import ResidualRecipe
from nvsf_core.recording.drive import Recording
from nvsf_core.simulation.pano_correction import pano_network
from nvsf_core.simulation.scene_model import SceneModel
from nvsf_core.simulation.sweep_simulation import field_renderer
from nvsf_core.simulation.turn_hits import hits_network


@dataclass(frozen=True, slots=True, kw_only=True)
class ResidualFields:
    """What is learned of one scene, for each sensor that the drive has."""

    lidar: LidarField | None
    camera: CameraEnsemble | None
    hits: CellNetwork | None = None
    """Corrects what returns in the LiDAR's own grid; None where the recipe has none."""
    pano: CellNetwork | None = None
    """Corrects the LiDAR's panos; None where the recipe has none."""

    def tensors(self) -> dict[str, Tensor]:
        """All weights, by sensor and name."""
        models = {"lidar": self.lidar, "camera": self.camera, "hits": self.hits, "pano": self.pano}
        return {
            f"{sensor}.{name}": value
            for sensor, model in models.items()
            if model is not None
            for name, value in model.state_dict().items()
        }


def make_fields(recipe: ResidualRecipe, recording: Recording, seed: int) -> ResidualFields:
    """Untrained fields of this scene's size."""
    lidar = camera = hits = pano = None
    if recording.lidar is not None:
        surfels = recording.lidar.evidence.surfels
        mean = surfels.mean_m
        bounds = Bounds.around(tuple(mean.min(axis=0).tolist()), tuple(mean.max(axis=0).tolist()))
        spec = needed_field(recipe.lidar_field, surfels)
        lidar = LidarField(spec, bounds, torch.Generator().manual_seed(seed))
        if recipe.hits is not None:
            hits = hits_network(recipe.hits, torch.Generator().manual_seed(seed + 3))
        if recipe.pano is not None and recipe.pano.training is not None:
            pano = pano_network(recipe.pano, torch.Generator().manual_seed(seed + 2))
    if recording.cameras:
        camera = CameraEnsemble(recipe.camera, torch.Generator().manual_seed(seed + 1))
    return ResidualFields(lidar=lidar, camera=camera, hits=hits, pano=pano)


def load(
    recipe: ResidualRecipe, weights: Weights, recording: Recording, *, with_camera: bool = True
) -> SceneModel:
    """Trained fields, ready to render; without cameras nothing of images is prepared.

    What did not beat `reproject` when it was judged is shown by that.

    Raises:
        StoreError: The weights are not the recipe's.
    """
    torch.set_num_threads(recipe.lidar_training.threads)
    facts = weights.facts
    fields = make_fields(recipe, recording, 0)
    lidar = camera = correct = pano = unknown = None
    if recording.lidar is not None:
        unknown = unknown_renderer(recording.lidar)
    if recording.lidar is not None and not facts.get(SHOWS_FIELD, True):
        # Its pano is the projection of its scan, as the baseline's.
        lidar = carrying_renderer(recording.lidar)
    elif fields.lidar is not None and recording.lidar is not None:
        weights.load_into(fields.lidar, "lidar.")
        lidar = field_renderer(
            fields.lidar,
            recording.lidar.evidence.standing,
            recording.lidar.moving(),
            most=recipe.evidence.lidar_candidates,
            far_m=recording.lidar.far_m,
        )
        if recipe.hits is not None and fields.hits is not None and facts.get(HITS_BLEND):
            weights.load_into(fields.hits, "hits.")
            correct = turn_hits(fields.hits, recording.lidar, facts[HITS_BLEND])
        if recipe.pano is not None:
            if fields.pano is not None:
                weights.load_into(fields.pano, "pano.")
            votes, corrected = recipe.evidence.votes, facts.get(CORRECTED, ())
            pano = pano_renderer(
                recording.lidar, recipe.pano, lidar, votes, fields.pano, corrected, correct, unknown
            )
    if fields.camera is not None and with_camera:
        weights.load_into(fields.camera, "camera.")
        corrections = corrections_from(facts.get(ALIGNED, {}))
        camera = camera_renderer(fields.camera, recording, recipe.camera, facts[LEARNED], corrections)
    return SceneModel(
        lidar=lidar, camera=camera, correct=correct, pano=pano, unknown=unknown, votes=recipe.evidence.votes
    )
