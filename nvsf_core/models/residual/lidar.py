"""The LiDAR field of the residual family: its training, and its comparison with `reproject`."""

import time
from dataclasses import asdict

import torch
from torch import Tensor

from nvsf_core._types import Scalar
from nvsf_core.evidence.surfels import Surfels
from nvsf_core.fields.lidar_field import LidarField
from nvsf_core.fields.surface_batch import SurfaceBatch, surface_batch
from nvsf_core.losses.lidar import depth_loss, intensity_loss, raydrop_loss, surface_likelihood
from nvsf_core.losses.total import LossBreakdown, total_loss
from nvsf_core.models.family import TrainedPart
from nvsf_core.models.holdout import compare
from nvsf_core.models.left_out_scans import (
    SCAN_METRICS,
    left_out_renderer,
    recorded_pano,
    score_left_out,
)
from nvsf_core.models.residual.training_rays import LidarRays, training_rays
from nvsf_core.recipe import ResidualRecipe
from nvsf_core.recording.drive import LidarRecording
from nvsf_core.rendering.lidar import LidarRender, render_lidar
from nvsf_core.rendering.reproject import NEAR_M
from nvsf_core.simulation.ray_renderers import field_renderer
from nvsf_core.training.loop import fresh_state, side_by_side
from nvsf_core.training.session import TrainingSession, fit, training_device

SHOWS_FIELD = "lidar_shows_field"
"""Name of the fact: whether the field beat `reproject` on the validation scans."""


def train_lidar(
    session: TrainingSession, field: LidarField, recipe: ResidualRecipe, lidar: LidarRecording
) -> TrainedPart:
    """Train the field on rays of the training scans; then choose whether it or `reproject` is used.

    Args:
        session: Of the scene.
        field: Is trained; on the CPU afterwards, where the evidence is.
        recipe: Of the scene.
        lidar: The recording.
    """
    started, spec = time.perf_counter(), recipe.lidar_training
    rays = training_rays(lidar, recipe, field)
    state = fresh_state(field.to(training_device()), spec, session.seed * 2)
    preparation = time.perf_counter() - started
    static = lidar.evidence.static
    fit(
        session, "lidar", state, spec,
        lambda _, generator: side_by_side(
            spec.parts, generator, lambda own: lidar_step(field, static, rays, recipe, lidar.far_m, own)
        ),
    )  # fmt: skip
    field.to("cpu")
    validating = time.perf_counter()
    shows_field, verdict = choose(field, recipe, lidar)
    preparation += time.perf_counter() - validating
    session.say("lidar", f"shows {verdict['lidar_shows']}")
    return TrainedPart(
        states={"lidar": state}, preparation_seconds=preparation,
        metadata={"training_rays": len(rays), **verdict}, facts={SHOWS_FIELD: shows_field},
    )  # fmt: skip


def choose(
    field: LidarField, recipe: ResidualRecipe, lidar: LidarRecording
) -> tuple[bool, dict[str, Scalar]]:
    """Whether the field renders the validation scans better than `reproject`, and the scores of both.

    Nothing of a validation scan is in the surfaces, moving objects and hit priors that both render from, nor
    in the field's training rays. Without validation scans the field is used.
    """
    left_out = lidar.evidence.left_out
    if left_out is None:
        return True, {"lidar_shows": "field: too few scans to compare it on"}

    numbers, votes = left_out.validation.tolist(), recipe.evidence.votes
    truth = {number: recorded_pano(lidar, number) for number in numbers}

    def by_field(number: int) -> list[float]:
        render = field_renderer(
            field, left_out.static, lidar.moving(leave_out=number),
            most=recipe.evidence.lidar_candidates, far_m=lidar.far_m,
        )  # fmt: skip
        return score_left_out(render, votes, lidar, number, truth[number])

    def by_evidence(number: int) -> list[float]:
        render = left_out_renderer(lidar, left_out, number)
        return score_left_out(render, votes, lidar, number, truth[number])

    found = compare(SCAN_METRICS, numbers, {"field": by_field, "reproject": by_evidence})
    shows_field = found.wins("field", "reproject")
    figures = found.figures({"field": "lidar_judged_", "reproject": "lidar_judged_reproject_"})
    shown = "field" if shows_field else "reproject: learning did not beat it"
    return shows_field, {"lidar_shows": shown, **figures}


def lidar_step(
    field: LidarField, surfels: Surfels, rays: LidarRays, recipe: ResidualRecipe, far_m: float,
    generator: torch.Generator,
) -> LossBreakdown:  # fmt: skip
    """The loss of a part of a step: a batch of rays, sampled from all training scans.

    Args:
        field: Is trained.
        surfels: Of the static scene; moving objects come with the rays.
        rays: Of all training scans.
        recipe: Rays and parts a step, surfaces a ray, loss weights.
        far_m: How far a ray is followed.
        generator: Samples the rays.
    """
    spec, device = recipe.lidar_training, next(field.parameters()).device
    sampled = torch.randint(len(rays), (spec.rays // spec.parts,), generator=generator).numpy()
    most = recipe.evidence.lidar_candidates
    batch = surface_batch(
        surfels, rays.origin_m[sampled], rays.direction[sampled], most=most, near_m=NEAR_M, far_m=far_m,
        objects=None if rays.objects is None else rays.objects.of(sampled),
    ).to(device)  # fmt: skip
    true_range_m, true_intensity, hit_prior = (
        torch.from_numpy(column[sampled]).to(device)
        for column in (rays.range_m, rays.intensity, rays.hit_prior)
    )
    rendered = render_lidar(field, batch, hit_prior)
    returned = (true_range_m > 0) & batch.is_there[:, 0]
    seen = batch.is_there[:, 0]
    terms = {
        "depth": _depth(rendered, batch, returned, true_range_m),
        "hit": raydrop_loss(rendered.hit_logit[seen], (true_range_m[seen] > 0).float()),
        "intensity": intensity_loss(rendered.intensity_logit[returned], true_intensity[returned]),
    }
    return total_loss(terms, asdict(recipe.losses))


def _depth(rendered: LidarRender, batch: SurfaceBatch, returned: Tensor, true_range_m: Tensor) -> Tensor:
    """Depth loss of each ray that `returned` (r,) bool: weighted range error, on moving objects a likelihood.

    A moving object is thin, met by few rays and mostly edges: there the weights must stay shares of rays.
    """
    of_returns = rendered.weights[returned], rendered.range_m[returned], true_range_m[returned]
    off_m = depth_loss(*of_returns)
    if not bool((batch.hit_prior >= 0.0).any()):
        return off_m
    meets = batch.spread((batch.hit_prior >= 0.0).float()[:, None])[returned, :, 0].any(dim=1)
    return torch.where(meets, surface_likelihood(*of_returns), off_m)
