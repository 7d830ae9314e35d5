"""The camera's part of a training step: L_rgb on pixels of one image."""

from collections.abc import Iterator
from dataclasses import asdict

import numpy as np
import torch
from torch import Tensor

from nvsf_core.losses.total import LossBreakdown, total_loss
from nvsf_core.models.paper.lidar_step import SUMS
from nvsf_core.models.paper.training_frames import Images, PaperFrames, PaperTrainee
from nvsf_core.rendering.scaled_rays import camera_rays
from nvsf_core.rendering.volume import on_white, render_volume
from nvsf_core.sampling.error_map import ErrorMap
from nvsf_core.sampling.pixels import sample_pixels


def camera_losses(
    trainee: PaperTrainee,
    frames: PaperFrames,
    camera: Images,
    row: int,
    epoch: int,
    generator: torch.Generator,
) -> Iterator[LossBreakdown]:
    """The losses of sampled pixels of one image, in parts to save memory; then the error map is updated.

    Args:
        trainee: Field and error maps.
        frames: All training data.
        camera: Whose image.
        row: Number of the image.
        epoch: From 0; decides how pixels are sampled.
        generator: Samples pixels and points on the rays.
    """
    recipe, errors = trainee.recipe, trainee.image_errors[camera.name]
    assert isinstance(errors, ErrorMap)
    pixels = sample_pixels(recipe.sampling, epoch, row, errors, generator)
    rows, columns = pixels.rows.numpy(), pixels.columns.numpy()
    pose, frame = camera.images.pose[row], float(camera.moment[row])
    direction = camera.images.pinhole.rays(np.stack([columns, rows], axis=1)) @ pose[:3, :3].T
    origin = np.broadcast_to(pose[:3, 3], direction.shape)
    rays = camera_rays(frames.bounds, origin, direction, near_m=recipe.sampling.near_m).to(trainee.device)
    truth = torch.from_numpy(camera.images.rgb[row, rows, columns]).to(trainee.device) / 255.0
    error: list[Tensor] = []
    for first in range(0, len(rays), recipe.sampling.rays_at_once):
        part = slice(first, first + recipe.sampling.rays_at_once)
        render = render_volume(
            lambda x01: trainee.field.density(x01, frame, "camera"),
            trainee.field.camera,
            rays.part(part),
            samples=recipe.sampling.samples,
            bound=frames.bounds.bound,
            generator=generator,
        )
        colour = on_white(render)
        terms = {"colour": (colour - truth[part]) ** 2}  # eq. 9 of the paper (L_rgb), to be summed
        error.append(terms["colour"].sum(dim=1).detach().cpu())
        yield total_loss(terms, asdict(recipe.losses), SUMS)
    errors.update(row, pixels.rows, pixels.columns, torch.cat(error))
