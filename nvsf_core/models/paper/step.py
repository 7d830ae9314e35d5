"""One step of the paper's training: LiDAR, flow and camera losses of one frame."""

from collections.abc import Iterator
from functools import partial

import numpy as np
import torch

from nvsf_core.losses.total import LossBreakdown
from nvsf_core.models.paper.camera_step import camera_losses
from nvsf_core.models.paper.flow_training import flow_loss
from nvsf_core.models.paper.lidar_step import lidar_losses
from nvsf_core.models.paper.training_frames import PaperFrames, PaperTrainee
from nvsf_core.training.loop import Part

_EPOCH_SEED = 1_000_003
_SEEDS = 2**62


def paper_step(
    trainee: PaperTrainee, frames: PaperFrames, seed: int, step: int, generator: torch.Generator
) -> list[Part]:
    """Eq. 10: l1 L_flow + l2 L_depth + l3 L_intensity + l4 L_raydrop + l5 L_grad + l6 L_rgb, of one frame.

    The LiDAR's losses are one part, the camera's another, each with a generator of its own. A part's losses
    come in pieces, because 2048 rays of 768 samples may not fit into memory. An epoch has each frame once, in
    an order that seed and epoch decide.

    Args:
        trainee: Field and error maps.
        frames: All training data.
        seed: Of the training.
        step: From 0.
        generator: Seeds what samples rays, pixels and points; samples the camera.
    """
    frame, epoch = frame_of_step(frames, seed, step)
    parts: list[Part] = []
    if frames.panos is not None:
        parts.append(partial(_of_lidar, trainee, frames, frame, epoch, _own(generator)))
    shown = [camera for camera in frames.cameras if camera.name in trainee.image_errors]
    shown = [camera for camera in shown if frame in camera.frame]
    if shown:
        # Of several cameras each step uses one, so that a step costs the same.
        camera = shown[int(torch.randint(len(shown), (1,), generator=generator))]
        row = int(np.flatnonzero(camera.frame == frame)[0])
        parts.append(partial(camera_losses, trainee, frames, camera, row, epoch, _own(generator)))
    return parts


def _of_lidar(
    trainee: PaperTrainee, frames: PaperFrames, frame: float, epoch: int, generator: torch.Generator
) -> Iterator[LossBreakdown]:
    """Losses of the scans of a frame, each followed by that of the flow there."""
    panos = frames.panos
    assert panos is not None
    for scan in np.flatnonzero(panos.frame == frame):
        yield from lidar_losses(trainee, frames, panos, int(scan), epoch, generator)
        if trainee.recipe.aggregate:
            flow, t = trainee.field.flow, trainee.field.time(frame)
            yield flow_loss(flow, trainee.recipe, panos.clouds, panos.frame, int(scan), t, generator)


def _own(generator: torch.Generator) -> torch.Generator:
    """A generator that `generator` seeds."""
    return torch.Generator().manual_seed(int(torch.randint(_SEEDS, (1,), generator=generator)))


def frame_of_step(frames: PaperFrames, seed: int, step: int) -> tuple[float, int]:
    """Frame coordinate of a step, and its epoch, counted from 0."""
    known = frames.frames
    epoch, place = divmod(step, len(known))
    order = torch.Generator().manual_seed(seed * _EPOCH_SEED + epoch)
    return float(known[int(torch.randperm(len(known), generator=order)[place])]), epoch
