"""One step of the paper's training: LiDAR, flow and camera losses of one frame."""

from collections.abc import Iterator

import numpy as np
import torch

from nvsf_core.losses.total import LossBreakdown
from nvsf_core.models.paper.training.camera import camera_losses
from nvsf_core.models.paper.training.flow import flow_loss
from nvsf_core.models.paper.training.frames import PaperFrames, PaperTrainee
from nvsf_core.models.paper.training.lidar import lidar_losses

_EPOCH_SEED = 1_000_003


def paper_step(
    trainee: PaperTrainee, frames: PaperFrames, seed: int, step: int, generator: torch.Generator
) -> Iterator[LossBreakdown]:
    """Eq. 10: l1 L_flow + l2 L_depth + l3 L_intensity + l4 L_raydrop + l5 L_grad + l6 L_rgb, of one frame.

    In parts whose gradients are added, because 2048 rays of 768 samples may not fit into memory. An epoch
    has each frame once, in an order that seed and epoch decide.

    Args:
        trainee: Field and error maps.
        frames: All training data.
        seed: Of the training.
        step: From 0.
        generator: Samples rays, pixels, points and the camera.
    """
    frame, epoch = frame_of_step(frames, seed, step)
    panos = frames.panos
    if panos is not None:
        for scan in np.flatnonzero(panos.frame == frame):
            yield from lidar_losses(trainee, frames, panos, int(scan), step, epoch, generator)
            if trainee.recipe.aggregate:
                flow, t = trainee.field.flow, trainee.field.time(frame)
                yield flow_loss(flow, trainee.recipe, panos.clouds, panos.frame, int(scan), t, generator)
    shown = [camera for camera in frames.cameras if camera.name in trainee.image_errors]
    shown = [camera for camera in shown if frame in camera.frame]
    if shown:
        # Of several cameras each step uses one, so that a step costs the same.
        camera = shown[int(torch.randint(len(shown), (1,), generator=generator))]
        row = int(np.flatnonzero(camera.frame == frame)[0])
        yield from camera_losses(trainee, frames, camera, row, epoch, generator)


def frame_of_step(frames: PaperFrames, seed: int, step: int) -> tuple[float, int]:
    """Frame coordinate of a step, and its epoch, counted from 0."""
    known = frames.frames
    epoch, place = divmod(step, len(known))
    order = torch.Generator().manual_seed(seed * _EPOCH_SEED + epoch)
    return float(known[int(torch.randperm(len(known), generator=order)[place])]), epoch
