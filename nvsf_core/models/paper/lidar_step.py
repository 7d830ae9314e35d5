"""The LiDAR's part of a training step: L_depth, L_intensity, L_raydrop, L_grad on rays of one pano."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass

import numpy as np
import torch
from torch import Tensor

from nvsf_core.losses.chamfer import ray_batch_chamfer
from nvsf_core.losses.gradient import gradient_loss, gradient_mask
from nvsf_core.losses.lidar import absolute_range_error, squared_hit_error, squared_intensity_error
from nvsf_core.losses.total import LossBreakdown, total_loss
from nvsf_core.models.paper.training_frames import Panos, PaperFrames, PaperTrainee
from nvsf_core.recipe.paper import PaperRecipe
from nvsf_core.rendering.scaled_rays import ScaledRays, lidar_rays
from nvsf_core.rendering.volume import VolumeRender, render_volume
from nvsf_core.sampling.pixels import SampledPixels, sample_lidar_pixels
from nvsf_core.sensors.linear_pano import LinearPano

SUMS = ("depth", "intensity", "raydrop", "gradient", "colour")
"""Terms that are summed over rays, as in the paper."""


@dataclass(frozen=True, slots=True)
class _Truth:
    """The recorded values of r rays."""

    range_m: Tensor
    """(r,) metres, 0 = no return."""
    intensity: Tensor
    """(r,)."""
    mask_x: Tensor
    """(r,) bool: where gradients along a row are compared."""
    mask_y: Tensor
    """(r,) bool: along a column."""

    def part(self, rays: slice) -> "_Truth":
        return _Truth(self.range_m[rays], self.intensity[rays], self.mask_x[rays], self.mask_y[rays])


def lidar_losses(
    trainee: PaperTrainee,
    frames: PaperFrames,
    panos: Panos,
    row: int,
    epoch: int,
    generator: torch.Generator,
) -> Iterator[LossBreakdown]:
    """The losses of sampled rays of one pano, in parts to save memory; then the error map is updated.

    Args:
        trainee: Field and error maps.
        frames: All training data.
        panos: Of `frames`.
        row: Number of the pano.
        epoch: From 0; decides how rays are sampled.
        generator: Samples rays and points on them.
    """
    recipe, errors = trainee.recipe, trainee.pano_errors
    assert errors is not None  # a scene with panos has their map
    pixels = sample_lidar_pixels(recipe.sampling, epoch, row, errors, generator)
    rays, truth = _rays(recipe, frames, panos, row, pixels, trainee.device)
    frame, patch = float(panos.frame[row]), pixels.patch or (1, 1)
    at_once = max(1, recipe.sampling.rays_at_once // (patch[0] * patch[1])) * patch[0] * patch[1]
    error: list[Tensor] = []
    for first in range(0, len(rays), at_once):
        part, true = rays.part(slice(first, first + at_once)), truth.part(slice(first, first + at_once))
        render = render_volume(
            lambda x01: trainee.field.density(x01, frame, "lidar"),
            trainee.field.lidar,
            part,
            samples=recipe.sampling.samples,
            bound=frames.bounds.bound,
            generator=generator,
        )
        terms = _terms(recipe, render, part, true, frames.bounds.half_m, pixels.patch)
        if "chamfer" in terms:
            # A mean over the step's rays, of which this part is a share.
            terms["chamfer"] = terms["chamfer"] * (len(part) / len(rays))
        error.append(_ray_error(recipe, terms))
        yield total_loss(terms, asdict(recipe.losses), SUMS)
    errors.update(row, pixels.rows, pixels.columns, torch.cat(error))


def _rays(
    recipe: PaperRecipe,
    frames: PaperFrames,
    panos: Panos,
    row: int,
    pixels: SampledPixels,
    device: torch.device,
) -> tuple[ScaledRays, _Truth]:
    """Rays through the sampled cells of a pano, and their recorded values."""
    height, width = panos.range_m.shape[1:]
    cells = (pixels.rows, pixels.columns)
    directions = LinearPano(height=height, width=width).directions(panos.turn_up_rad)
    direction = directions[tuple(one.numpy() for one in cells)]
    rotation, position = panos.pose[row][:3, :3], panos.pose[row][:3, 3]
    origin, spec = np.broadcast_to(position, direction.shape), recipe.sampling
    rays = lidar_rays(frames.bounds, origin, direction @ rotation.T, near_m=spec.near_m, far_m=spec.far_m)
    pano_m = panos.range_m[row]
    # Of the whole pano: at a patch's border there is no second difference.
    masks = gradient_mask(pano_m, recipe.gradient.mask, recipe.gradient.threshold_m)
    truth = (pano_m[cells], panos.intensity[row][cells], masks[0][cells], masks[1][cells])
    return rays.to(device), _Truth(*(value.to(device) for value in truth))


def _terms(
    recipe: PaperRecipe,
    render: VolumeRender,
    rays: ScaledRays,
    truth: _Truth,
    half_m: float,
    patch: tuple[int, int] | None,
) -> dict[str, Tensor]:
    """Each term unreduced; only those with a weight are computed."""
    weights, true_scaled = recipe.losses, truth.range_m / half_m
    if recipe.slips.half_precision_truth:
        true_scaled = true_scaled.half().float()
    intensity, hit = render.attributes.unbind(dim=1)
    is_return, range_m = truth.range_m > 0, render.range_scaled * half_m
    terms = {
        "depth": absolute_range_error(render.range_scaled, true_scaled),
        "intensity": squared_intensity_error(intensity, truth.intensity, is_return),
        "raydrop": squared_hit_error(hit, is_return),
    }
    if weights.gradient and patch is not None:
        terms["gradient"] = gradient_loss(
            range_m.view(-1, *patch),
            truth.range_m.view(-1, *patch),
            truth.mask_x.view(-1, *patch),
            truth.mask_y.view(-1, *patch),
            recipe.gradient.norm,
        )
    if weights.chamfer:
        terms["chamfer"] = ray_batch_chamfer(rays.direction, range_m, truth.range_m)
    return terms


def _ray_error(recipe: PaperRecipe, terms: dict[str, Tensor]) -> Tensor:
    """Weighted depth, intensity and ray-drop loss of each ray, for the error map."""
    weights = recipe.losses
    error = weights.depth * terms["depth"] + weights.intensity * terms["intensity"]
    return (error + weights.raydrop * terms["raydrop"]).detach().cpu()
