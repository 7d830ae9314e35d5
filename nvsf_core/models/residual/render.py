"""Loads a trained residual model as a scene model that can be rendered."""

from dataclasses import replace

from nvsf_core.models.baselines.reproject import carrying_renderer, unobserved_renderer
from nvsf_core.models.family import Weights
from nvsf_core.models.residual.camera import ALIGNED, LEARNED, camera_renderer
from nvsf_core.models.residual.capacity import ResidualFields, make_fields
from nvsf_core.models.residual.lidar import SHOWS_FIELD
from nvsf_core.models.residual.pano import CORRECTED, pano_renderer
from nvsf_core.models.residual.pose_refinement import corrections_from
from nvsf_core.models.residual.raydrop import HITS_BLEND, raydrop_correction
from nvsf_core.recipe import ResidualRecipe
from nvsf_core.recording.drive import LidarRecording, Recording
from nvsf_core.simulation.ray_renderers import field_renderer
from nvsf_core.simulation.scene_model import SceneModel


def load(
    recipe: ResidualRecipe, weights: Weights, recording: Recording, *, with_camera: bool = True
) -> SceneModel:
    """A trained model, ready to render; without cameras no image is prepared.

    A part that did not beat `reproject` on the validation data is rendered by `reproject`.

    Raises:
        StoreError: The weights do not fit the recipe.
    """
    facts = weights.facts
    fields = make_fields(recipe, recording, 0)
    model = SceneModel(lidar=None, camera=None, prior_scans=recipe.evidence.votes)
    if recording.lidar is not None:
        model = replace(model, unobserved=unobserved_renderer(recording.lidar))
        if not facts.get(SHOWS_FIELD, True):
            # Without a pano renderer its pano is the projection of its scan, as for the baseline.
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
    """The model with the trained field, its raydrop network and its pano."""
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
