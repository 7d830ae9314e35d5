"""One step of the paper's training."""

from collections.abc import Iterator
from dataclasses import asdict

import numpy as np
import torch
from torch import Tensor

from nvsf_core.losses.scene_flow import flow_magnitude, scene_flow_loss
from nvsf_core.losses.total import LossBreakdown, total_loss
from nvsf_core.training.paper_camera import camera_losses
from nvsf_core.training.paper_frames import Panos, PaperFrames
from nvsf_core.training.paper_lidar import lidar_losses
from nvsf_core.training.paper_trainee import PaperTrainee

_EPOCH_SEED = 1_000_003


def paper_step(
    trainee: PaperTrainee, frames: PaperFrames, seed: int, step: int, generator: torch.Generator
) -> Iterator[LossBreakdown]:
    """L_total = l1 L_flow + l2 L_depth + l3 L_intensity + l4 L_raydrop + l5 L_grad + l6 L_rgb, of one frame.

    In parts whose gradients add up: 2048 rays of 768 samples need not fit into memory together. Every epoch
    shows each frame once, in an order of its own that seed and epoch decide.
    """
    frame, epoch = turn(frames, seed, step)
    panos = frames.panos
    if panos is not None:
        for scan in np.flatnonzero(panos.frame == frame):
            yield from lidar_losses(trainee, frames, panos, int(scan), step, epoch, generator)
            yield flow_loss(trainee, panos, int(scan), generator)
    shown = [camera for camera in frames.cameras if camera.name in trainee.image_errors]
    shown = [camera for camera in shown if frame in camera.frame]
    if shown:
        # With several cameras each step looks through one of them, so that a step costs the same.
        camera = shown[int(torch.randint(len(shown), (1,), generator=generator))]
        row = int(np.flatnonzero(camera.frame == frame)[0])
        yield from camera_losses(trainee, frames, camera, row, epoch, generator)


def turn(frames: PaperFrames, seed: int, step: int) -> tuple[float, int]:
    """Which frame a step learns from, and its epoch, counted from 0."""
    known = frames.frames
    epoch, place = divmod(step, len(known))
    order = torch.Generator().manual_seed(seed * _EPOCH_SEED + epoch)
    return float(known[int(torch.randperm(len(known), generator=order)[place])]), epoch


def flow_loss(
    trainee: PaperTrainee, panos: Panos, row: int, generator: torch.Generator
) -> LossBreakdown:
    """L_flow of a frame towards the neighbouring training scans that there are; empty without a cloud."""
    recipe, field = trainee.recipe, trainee.field
    here = _drawn(panos.clouds[row], recipe.flow.points, generator, trainee.device)
    if not recipe.aggregate or not len(here):
        return total_loss({}, {})
    frame = float(panos.frame[row])
    x01 = here / (2.0 * recipe.slips.bound) + 0.5
    forward, backward = field.flow(x01, field.time(frame))
    after, before = (
        _drawn(panos.clouds[int(found[0])], recipe.flow.points, generator, trainee.device)
        if len(found := np.flatnonzero(panos.frame == frame + step))
        else None
        for step in (1.0, -1.0)
    )
    terms = {"flow": scene_flow_loss(here, forward, backward, after, before)}
    if recipe.losses.flow_magnitude:
        terms["flow_magnitude"] = flow_magnitude(forward, backward)
    # The paper adds the distances to both neighbours.
    return total_loss(terms, asdict(recipe.losses), ("flow",))


def _drawn(cloud: np.ndarray, most: int, generator: torch.Generator, device: torch.device) -> Tensor:
    """At most that many points of a cloud (m, 3), without replacement."""
    points = torch.from_numpy(cloud)
    if len(points) > most:
        points = points[torch.randperm(len(points), generator=generator)[:most]]
    return points.to(device)
