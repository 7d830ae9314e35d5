"""The family `paper` (recipes `paper`, `paper_cpu`, ...): trains the field, then the U-Net; see `Family`.

The field learns from rays of one frame a step, the U-Net from whole panos.
"""

import time
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from nvsf_core._types import Scalar
from nvsf_core.fields.raydrop_unet import RaydropUnet
from nvsf_core.models.family import Trained, TrainingSession, fit, training_device
from nvsf_core.models.paper.refine import refine, refinement_state
from nvsf_core.models.paper.render import PaperModel
from nvsf_core.models.paper.scene import frame_at, needed, training_frames
from nvsf_core.models.paper.scene import load as load
from nvsf_core.models.paper.step import paper_step
from nvsf_core.models.paper.training_frames import PaperFrames, PaperTrainee
from nvsf_core.recipe.paper import PaperRecipe
from nvsf_core.recipe.residual import TrainingSpec
from nvsf_core.recording.drive import Recording
from nvsf_core.training.adam import Adam
from nvsf_core.training.loop import Part, Step, TrainingState
from nvsf_core.training.weight_average import WeightAverage


def train(recipe: PaperRecipe, recording: Recording, session: TrainingSession) -> Trained:
    """Gather the training frames and train on them, resuming from the session's checkpoints."""
    started = time.perf_counter()
    recipe = needed(recipe, recording)
    frames = training_frames(recipe, recording)
    prepared_s = time.perf_counter() - started
    trained = train_on_frames(recipe, recording, frames, session)
    return replace(trained, seconds=trained.seconds + prepared_s)


def train_on_frames(
    recipe: PaperRecipe, recording: Recording, frames: PaperFrames, session: TrainingSession
) -> Trained:
    """Train on prepared frames, which several runs may share."""
    seed = session.seed
    trainee = PaperTrainee(recipe, frames, torch.Generator().manual_seed(seed)).to(training_device())
    state = _state(trainee, recipe, seed)
    spec = recipe.optimiser
    loop = TrainingSpec(
        steps=spec.steps, rays=recipe.sampling.rays * (2 if recipe.sampling.camera else 1),
        final_share=spec.final_share, checkpoint_s=spec.checkpoint_s,
    )  # fmt: skip
    state = fit(session, "field", state, loop, _step(state, trainee, frames, seed))
    assert state.average is not None
    if state.step % len(frames.frames) == 0:
        # The average is else updated at the first step of the next epoch.
        state.average.update()
    curves, seconds = {"field": state.curve}, state.seconds
    tensors: dict[str, Tensor] = {}
    with state.average.in_place():
        if recipe.refinement.channels and frames.panos is not None:
            refined = _refine(recipe, recording, frames, trainee, session)
            curves["refinement"], seconds = refined.curve, seconds + refined.seconds
            tensors = {f"unet.{name}": value for name, value in refined.model.state_dict().items()}
        tensors |= {f"field.{name}": value.clone() for name, value in trainee.field.state_dict().items()}
    return Trained(
        tensors={name: value.cpu() for name, value in tensors.items()},
        curves=curves,
        seconds=seconds,
        metadata=_metadata(frames, state),
        facts={
            "centre_m": list(frames.bounds.centre_m),
            "half_m": frames.bounds.half_m,
            "bound": frames.bounds.bound,
        },
    )


def _state(trainee: PaperTrainee, recipe: PaperRecipe, seed: int) -> TrainingState:
    """The state before the first step: Adam with the paper's groups, and the weight average."""
    groups = trainee.field.parameter_groups(recipe.optimiser)
    for group in groups:
        group["initial_lr"] = group["lr"]
    optimiser = Adam(groups, betas=(0.9, 0.99), eps=1e-15)
    average = WeightAverage(trainee.field, recipe.optimiser.ema_decay)
    return TrainingState(trainee, optimiser, torch.Generator().manual_seed(seed), average=average)


def _step(state: TrainingState, trainee: PaperTrainee, frames: PaperFrames, seed: int) -> Step:
    def step(number: int, generator: torch.Generator) -> list[Part]:
        # Before the first step of an epoch, so that a run resumed there updates the average once.
        if number and number % len(frames.frames) == 0 and state.average is not None:
            state.average.update()
        return paper_step(trainee, frames, seed, number, generator)

    return step


def _refine(
    recipe: PaperRecipe,
    recording: Recording,
    frames: PaperFrames,
    trainee: PaperTrainee,
    session: TrainingSession,
) -> TrainingState:
    """Render training panos with the averaged weights, and train the U-Net on them."""
    panos, spec, started = frames.panos, recipe.refinement, time.perf_counter()
    assert panos is not None
    model = PaperModel(
        recipe=recipe,
        field=trainee.field,
        bounds=frames.bounds,
        frame_at=frame_at(recording),
        unet=None,
        turn_up_rad=panos.turn_up_rad,
    )
    chosen = _evenly(len(panos.frame), spec.panos)
    renders = []
    for k in chosen.tolist():
        renders.append(model.raw_pano(panos.pose[k], float(panos.frame[k]), spec.column_step))
        session.say("refinement", f"pano {len(renders)} of {len(chosen)} rendered for the U-Net")
    generator = torch.Generator().manual_seed(session.seed)
    is_return = panos.range_m[chosen][:, :, :: spec.column_step] > 0
    unet = RaydropUnet(spec.channels, generator).to(training_device())
    unet.expect(float(is_return.float().mean()))
    state = refinement_state(unet, spec, generator)
    rendered_s = time.perf_counter() - started
    with session.resumed("refinement", state) as part:
        refine(
            state, spec, torch.stack(renders), is_return, part.save, part.say,
            checkpoint_s=recipe.optimiser.checkpoint_s,
        )  # fmt: skip
    state.seconds += rendered_s
    return state


def _evenly(count: int, wanted: int) -> np.ndarray:
    """`wanted` of the numbers below `count`, evenly spread; 0 = all."""
    if wanted == 0 or wanted >= count:
        return np.arange(count)
    return np.round(np.linspace(0, count - 1, wanted)).astype(np.int64)


def _metadata(frames: PaperFrames, state: TrainingState) -> dict[str, Scalar]:
    found: dict[str, Scalar] = {
        "training_panos": 0 if frames.panos is None else len(frames.panos.frame),
        "training_images": sum(len(camera.frame) for camera in frames.cameras),
        "scene_half_edge_m": frames.bounds.half_m,
        "seconds_a_step": state.seconds / max(1, state.step),
    }
    if torch.cuda.is_available():
        found["peak_gpu_memory_mb"] = torch.cuda.max_memory_allocated() / 2**20
    return found
