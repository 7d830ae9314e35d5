"""Training the residual fields: one a sensor that the drive has, one after the other."""

import time
from dataclasses import asdict

import torch

from nvsf_core._types import Scalar
from nvsf_core.models.family import Trained
from nvsf_core.models.residual.camera import ALIGNED, LEARNED, train_camera
from nvsf_core.models.residual.capacity import make_fields
from nvsf_core.models.residual.lidar import SHOWS_FIELD, choose, lidar_step
from nvsf_core.models.residual.pano import CORRECTED, train_pano
from nvsf_core.models.residual.raydrop import HITS_BLEND, train_hits
from nvsf_core.models.residual.training_rays import training_rays
from nvsf_core.recipe import ResidualRecipe, TrainingSpec
from nvsf_core.recording.drive import Recording
from nvsf_core.training.loop import TrainingState, make_optimiser
from nvsf_core.training.session import TrainingSession, fit


def train(recipe: ResidualRecipe, recording: Recording, session: TrainingSession) -> Trained:
    """Train, resuming from the session's checkpoints."""
    started = time.perf_counter()
    torch.set_num_threads(recipe.lidar_training.threads)
    fields = make_fields(recipe, recording, session.seed)
    states: dict[str, TrainingState] = {}
    metadata: dict[str, Scalar] = {}
    facts: dict[str, object] = {}
    seconds = time.perf_counter() - started
    if fields.lidar is not None and recording.lidar is not None:
        field, evidence, far_m = fields.lidar, recording.lidar.evidence, recording.lidar.far_m
        rays = training_rays(recording.lidar, recipe, field)
        metadata["training_rays"] = len(rays)
        seconds = time.perf_counter() - started
        states["lidar"] = fit(
            session, "lidar", _state(session, field, recipe.lidar_training), recipe.lidar_training,
            lambda _, generator: [lidar_step(field, evidence.static, rays, recipe, far_m, generator)],
        )  # fmt: skip
        judging = time.perf_counter()
        facts[SHOWS_FIELD], verdict = choose(field, recipe, recording.lidar)
        seconds += time.perf_counter() - judging
        metadata |= verdict
        session.say("lidar", f"shows {verdict['lidar_shows']}")
    correct = None
    if facts.get(SHOWS_FIELD) and fields.hits and fields.lidar and recording.lidar:
        hits = train_hits(session, fields.hits, fields.lidar, recipe, recording.lidar)
        states |= hits.states
        seconds += hits.preparation_seconds
        metadata |= hits.metadata
        correct = hits.correct
        facts[HITS_BLEND] = None if correct is None else asdict(correct.blend)
        session.say("hits", f"shows {hits.metadata['hits_shown']}")
    if facts.get(SHOWS_FIELD) and fields.pano and fields.lidar and recording.lidar:
        expected = train_pano(session, fields.pano, fields.lidar, recipe, recording.lidar, correct)
        states |= expected.states
        seconds += expected.preparation_seconds
        metadata |= expected.metadata
        facts[CORRECTED] = expected.corrected
    if fields.camera is not None:
        trained = train_camera(session, fields.camera, recipe, recording)
        states |= trained.states
        seconds += trained.preparation_seconds
        metadata |= trained.metadata
        facts[LEARNED] = trained.learned
        facts[ALIGNED] = trained.corrections
    for sensor, state in states.items():
        metadata[f"{sensor}_seconds"] = state.seconds
    return Trained(
        tensors=fields.tensors(),
        curves={sensor: state.curve for sensor, state in states.items()},
        seconds=seconds + sum(state.seconds for state in states.values()),
        metadata=metadata,
        facts=facts,
    )


def _state(session: TrainingSession, model: torch.nn.Module, spec: TrainingSpec) -> TrainingState:
    """A field before its first step."""
    generator = torch.Generator().manual_seed(session.seed * 2)
    return TrainingState(model, make_optimiser(model, spec), generator)
