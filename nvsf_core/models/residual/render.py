"""The residual recipes: small fields that correct what the LiDAR proves, or replace what it lacks."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from nvsf_core.fields.camera_networks import CameraEnsemble
from nvsf_core.fields.cell_network import CellNetwork
from nvsf_core.fields.lidar_field import LidarField
from nvsf_core.geometry.bounds import Bounds
from nvsf_core.models.baselines.reproject import carrying_renderer, unobserved_renderer
from nvsf_core.models.family import Weights
from nvsf_core.models.residual.camera import ALIGNED, LEARNED, camera_renderer
from nvsf_core.models.residual.capacity import needed_field
from nvsf_core.models.residual.lidar import SHOWS_FIELD
from nvsf_core.models.residual.pano import CORRECTED, pano_renderer
from nvsf_core.models.residual.pose_refinement import corrections_from
from nvsf_core.models.residual.raydrop import HITS_BLEND, raydrop_correction
from nvsf_core.recipe import ResidualRecipe
from nvsf_core.recording.drive import LidarRecording, Recording
from nvsf_core.simulation.pano_correction import pano_network
from nvsf_core.simulation.ray_renderers import field_renderer
from nvsf_core.simulation.raydrop_grid import hits_network
from nvsf_core.simulation.scene_model import SceneModel


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
    model = SceneModel(lidar=None, camera=None, prior_scans=recipe.evidence.votes)
    if recording.lidar is not None:
        model = replace(model, unobserved=unobserved_renderer(recording.lidar))
        if not facts.get(SHOWS_FIELD, True):
            # Its pano is the projection of its scan, as the baseline's.
            model = replace(model, lidar=carrying_renderer(recording.lidar))
        elif fields.lidar is not None:
            model = _with_lidar(model, recipe, fields, weights, recording.lidar)
    if fields.camera is not None and with_camera:
        weights.load_into(fields.camera, "camera.")
        corrections = corrections_from(facts.get(ALIGNED, {}))
        camera = camera_renderer(fields.camera, recording, recipe.camera, facts[LEARNED], corrections)
        model = replace(model, camera=camera)
    return model


def _with_lidar(
    model: SceneModel, recipe: ResidualRecipe, fields: ResidualFields, weights: Weights, lidar: LidarRecording
) -> SceneModel:
    """The model with the trained field, and with what corrects its hits and its panos."""
    assert fields.lidar is not None
    facts = weights.facts
    weights.load_into(fields.lidar, "lidar.")
    render = field_renderer(
        fields.lidar, lidar.evidence.static, lidar.moving(), most=recipe.evidence.lidar_candidates,
        far_m=lidar.far_m,
    )  # fmt: skip
    correct = None
    if fields.hits is not None and facts.get(HITS_BLEND):
        weights.load_into(fields.hits, "hits.")
        correct = raydrop_correction(fields.hits, lidar, facts[HITS_BLEND])
    model = replace(model, lidar=render, correct=correct)
    if recipe.pano is None:
        return model
    if fields.pano is not None:
        weights.load_into(fields.pano, "pano.")
    pano = pano_renderer(model, lidar, recipe.pano, fields.pano, facts.get(CORRECTED, ()))
    return replace(model, pano=pano)
