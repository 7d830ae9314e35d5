"""The family `residual` (recipes `lean`, `quick`, `short`, `smoke`): trains and loads its parts."""

import time
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from nvsf_core._types import Scalar
from nvsf_core.fields.layers import CellNetwork
from nvsf_core.fields.lidar_field import LidarField
from nvsf_core.models.family import Trained, TrainedPart, TrainingSession, Weights
from nvsf_core.models.residual.camera import camera_renderer, train_camera
from nvsf_core.models.residual.lidar import SHOWS_FIELD, train_lidar
from nvsf_core.models.residual.pano import CORRECTED, pano_renderer, train_pano
from nvsf_core.models.residual.pano_neighbours import FEATURES as PANO_FEATURES
from nvsf_core.models.residual.pano_neighbours import PARTS
from nvsf_core.models.residual.raydrop import HITS_BLEND, train_hits
from nvsf_core.models.residual.raydrop_grid import FEATURES as HITS_FEATURES
from nvsf_core.models.residual.raydrop_grid import SweepRaydrop
from nvsf_core.recipe.residual import ResidualRecipe
from nvsf_core.recording.drive import LidarRecording, Recording
from nvsf_core.simulation.ray_renderers import field_renderer, reprojecting_renderer
from nvsf_core.simulation.raydrop import HitBlend
from nvsf_core.simulation.scene_model import SceneModel


@dataclass(frozen=True, slots=True, kw_only=True)
class ResidualFields:
    """The learned parts of one scene's model."""

    lidar: LidarField | None
    """None where the drive has no LiDAR."""
    hits: CellNetwork | None = None
    """The raydrop network; None where the recipe has none."""
    pano: CellNetwork | None = None
    """Corrects panos; None where the recipe has none."""

    def tensors(self) -> dict[str, Tensor]:
        """All weights on the CPU, named `<part>.<weight>`."""
        parts: dict[str, nn.Module | None] = {
            "lidar": self.lidar, "hits": self.hits, "pano": self.pano
        }  # fmt: skip
        return {
            f"{part}.{name}": value.cpu()
            for part, model in parts.items()
            if model is not None
            for name, value in model.state_dict().items()
        }


def make_fields(recipe: ResidualRecipe, recording: Recording, seed: int) -> ResidualFields:
    """Untrained parts, each with weights from its own seed."""
    lidar = hits = pano = None
    if recording.lidar is not None:
        if recipe.hits is not None:
            hits = CellNetwork(HITS_FEATURES, 1, recipe.hits, torch.Generator().manual_seed(seed + 3))
        if recipe.pano is not None and recipe.pano.training is not None:
            sampler = torch.Generator().manual_seed(seed + 2)
            pano = CellNetwork(PANO_FEATURES, len(PARTS), recipe.pano, sampler)
        points_m = recording.lidar.evidence.static.mean_m
        lidar = LidarField.around(points_m, recipe.lidar_field, torch.Generator().manual_seed(seed))
    return ResidualFields(lidar=lidar, hits=hits, pano=pano)


def train(recipe: ResidualRecipe, recording: Recording, session: TrainingSession) -> Trained:
    """Train all parts of a scene's model, resuming from the session's checkpoints."""
    started = time.perf_counter()
    fields = make_fields(recipe, recording, session.seed)
    metadata: dict[str, Scalar] = {}
    seconds = time.perf_counter() - started
    parts: list[TrainedPart] = []
    if recording.lidar is not None:
        parts += _train_lidar_parts(session, fields, recipe, recording.lidar)
    if recording.cameras:
        parts.append(train_camera(session, recipe, recording))
    states = {sensor: state for part in parts for sensor, state in part.states.items()}
    facts: dict[str, object] = {}
    for part in parts:
        seconds += part.preparation_seconds
        metadata |= part.metadata
        facts |= part.facts
    for sensor, state in states.items():
        metadata[f"{sensor}_seconds"] = state.seconds
    tensors = fields.tensors()
    metadata["parameters"] = sum(value.numel() for value in tensors.values())
    for part in parts:
        tensors |= part.tensors
    return Trained(
        tensors=tensors,
        curves={sensor: state.curve for sensor, state in states.items()},
        seconds=seconds + sum(state.seconds for state in states.values()),
        metadata=metadata,
        facts=facts,
    )


def _train_lidar_parts(
    session: TrainingSession, fields: ResidualFields, recipe: ResidualRecipe, lidar: LidarRecording
) -> list[TrainedPart]:
    """The field, and if it is used the networks of hits and panos, which correct it."""
    assert fields.lidar is not None
    parts = [train_lidar(session, fields.lidar, recipe, lidar)]
    if not parts[0].facts[SHOWS_FIELD]:
        return parts
    correct = None
    if fields.hits is not None:
        hits = train_hits(session, fields.hits, fields.lidar, recipe, lidar)
        parts.append(hits)
        correct = hits.correct
        session.say("hits", f"shows {hits.metadata['hits_shown']}")
    if fields.pano is not None:
        parts.append(train_pano(session, fields.pano, fields.lidar, recipe, lidar, correct))
    return parts


def load(
    recipe: ResidualRecipe, weights: Weights, recording: Recording, *, with_camera: bool = True
) -> SceneModel:
    """A trained model, ready to render; without cameras no image is prepared.

    A part that did not beat `reproject` on the validation data is rendered by `reproject`. See `Family.load`.
    """
    facts = weights.facts
    fields = make_fields(recipe, recording, 0)
    model = SceneModel(lidar=None, camera=None, prior_scans=recipe.evidence.votes, copies_unmet=True)
    if recording.lidar is not None:
        if not facts.get(SHOWS_FIELD, True):
            # Without a pano renderer its pano is the projection of its scan, as for the baseline.
            model = replace(model, lidar=reprojecting_renderer(recording.lidar))
        elif fields.lidar is not None:
            model = _with_lidar(model, recipe, fields, weights, recording.lidar)
    if recording.cameras and with_camera:
        model = replace(model, camera=camera_renderer(recording, recipe.camera, weights))
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
        correct = SweepRaydrop(fields.hits, HitBlend(**facts[HITS_BLEND]))
    model = replace(model, lidar=render, correct=correct)
    if recipe.pano is None:
        return model
    if fields.pano is not None:
        weights.load_into(fields.pano, "pano.")
    pano = pano_renderer(model, lidar, recipe.pano, fields.pano, facts.get(CORRECTED, ()))
    return replace(model, pano=pano)
