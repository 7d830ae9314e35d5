"""Trains a residual recipe: the LiDAR field, its raydrop network, its pano network, the camera networks."""

import time

from nvsf_core._types import Scalar
from nvsf_core.models.family import Trained, TrainedPart
from nvsf_core.models.residual.camera import train_camera
from nvsf_core.models.residual.capacity import make_fields
from nvsf_core.models.residual.lidar import SHOWS_FIELD, choose, lidar_step
from nvsf_core.models.residual.pano import train_pano
from nvsf_core.models.residual.raydrop import train_hits
from nvsf_core.models.residual.training_rays import training_rays
from nvsf_core.recipe import ResidualRecipe
from nvsf_core.recording.drive import Recording
from nvsf_core.training.device import training_device
from nvsf_core.training.loop import TrainingState, fresh_state, side_by_side
from nvsf_core.training.session import TrainingSession, fit


def train(recipe: ResidualRecipe, recording: Recording, session: TrainingSession) -> Trained:
    """Train all parts of a scene's model, resuming from the session's checkpoints."""
    started = time.perf_counter()
    fields = make_fields(recipe, recording, session.seed)
    states: dict[str, TrainingState] = {}
    metadata: dict[str, Scalar] = {}
    facts: dict[str, object] = {}
    seconds = time.perf_counter() - started
    if fields.lidar is not None and recording.lidar is not None:
        field, spec = fields.lidar, recipe.lidar_training
        static, far_m = recording.lidar.evidence.static, recording.lidar.far_m
        rays = training_rays(recording.lidar, recipe, field)
        metadata["training_rays"] = len(rays)
        seconds = time.perf_counter() - started
        state = fresh_state(field.to(training_device()), spec, session.seed * 2)
        states["lidar"] = fit(
            session, "lidar", state, spec,
            lambda _, generator: side_by_side(
                spec.parts, generator, lambda own: lidar_step(field, static, rays, recipe, far_m, own)
            ),
        )  # fmt: skip
        # Sweeps are rendered on the CPU, where the evidence is.
        field.to("cpu")
        validating = time.perf_counter()
        facts[SHOWS_FIELD], verdict = choose(field, recipe, recording.lidar)
        seconds += time.perf_counter() - validating
        metadata |= verdict
        session.say("lidar", f"shows {verdict['lidar_shows']}")
    parts: list[TrainedPart] = []
    correct = None
    if facts.get(SHOWS_FIELD) and fields.hits and fields.lidar and recording.lidar:
        hits = train_hits(session, fields.hits, fields.lidar, recipe, recording.lidar)
        parts.append(hits)
        correct = hits.correct
        session.say("hits", f"shows {hits.metadata['hits_shown']}")
    if facts.get(SHOWS_FIELD) and fields.pano and fields.lidar and recording.lidar:
        parts.append(train_pano(session, fields.pano, fields.lidar, recipe, recording.lidar, correct))
    if fields.camera is not None:
        parts.append(train_camera(session, fields.camera, recipe, recording))
    for part in parts:
        states |= part.states
        seconds += part.preparation_seconds
        metadata |= part.metadata
        facts |= part.facts
    for sensor, state in states.items():
        metadata[f"{sensor}_seconds"] = state.seconds
    return Trained(
        tensors=fields.tensors(),
        curves={sensor: state.curve for sensor, state in states.items()},
        seconds=seconds + sum(state.seconds for state in states.values()),
        metadata=metadata,
        facts=facts,
    )
