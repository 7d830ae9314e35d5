"""The LiDAR field of the residual family: its training, and its comparison with `reproject`."""

import time
from dataclasses import asdict

import numpy as np
import torch
from torch import Tensor

from nvsf_core._types import Scalar
from nvsf_core.evidence.surfels import Surfels
from nvsf_core.fields.lidar_field import LidarField
from nvsf_core.fields.surface_batch import SurfaceBatch, surface_batch
from nvsf_core.losses.lidar import depth_loss, intensity_loss, raydrop_loss, surface_likelihood
from nvsf_core.losses.total import LossBreakdown, total_loss
from nvsf_core.metrics.point_cloud import point_cloud_metrics
from nvsf_core.metrics.range_and_intensity import intensity_image_metrics, range_image_metrics
from nvsf_core.models.family import TrainedPart
from nvsf_core.models.holdout import compare
from nvsf_core.models.residual.training_rays import LidarRays, training_rays
from nvsf_core.recipe import EvidenceSpec, ResidualRecipe
from nvsf_core.recording.drive import LidarRecording
from nvsf_core.rendering.lidar import LidarRender, render_lidar
from nvsf_core.rendering.rendered import RenderedRays
from nvsf_core.rendering.reproject import NEAR_M
from nvsf_core.sensors.linear_pano import LinearPano
from nvsf_core.simulation.ray_renderers import evidence_renderer, field_renderer
from nvsf_core.simulation.raydrop import rays_return
from nvsf_core.simulation.scan import RenderedSweep, SweepRays
from nvsf_core.simulation.scene_model import RayRenderer, SceneModel, SweepCorrector
from nvsf_core.simulation.sweep_simulation import fire_sweep
from nvsf_core.simulation.view_plan import recorded_sweep
from nvsf_core.training.loop import fresh_state, side_by_side
from nvsf_core.training.session import TrainingSession, fit, training_device

SHOWS_FIELD = "lidar_shows_field"
"""Name of the fact: whether the field beat `reproject` on the validation scans."""
_METRICS = {
    "chamfer_m2": False, "f_score": True, "range_psnr_db": True, "intensity_psnr_db": True,
    "hit_accuracy": True,
}  # fmt: skip
"""As in the protocol `lidar4d_scan`, and whether higher is better. But hit accuracy is that of the firings:
in a pano's cells false returns are hidden behind nearer ones."""
_PANO = LinearPano(reference_quirks=True)


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

    numbers, far_m = left_out.validation.tolist(), lidar.far_m
    moving = {number: lidar.moving(leave_out=number) for number in numbers}
    truth = {number: recorded_pano(lidar, number) for number in numbers}

    def by_field(number: int) -> list[float]:
        most = recipe.evidence.lidar_candidates
        render = field_renderer(field, left_out.static, moving[number], most=most, far_m=far_m)
        return _score(render, recipe, lidar, number, truth[number])

    def by_evidence(number: int) -> list[float]:
        most = EvidenceSpec().lidar_candidates
        render = evidence_renderer(left_out.for_rendering, moving[number], most=most, far_m=far_m)
        return _score(render, recipe, lidar, number, truth[number])

    found = compare(_METRICS, numbers, {"field": by_field, "reproject": by_evidence})
    shows_field = found.wins("field", "reproject")
    figures = found.figures({"field": "lidar_judged_", "reproject": "lidar_judged_reproject_"})
    shown = "field" if shows_field else "reproject: learning did not beat it"
    return shows_field, {"lidar_shows": shown, **figures}


def recorded_pano(lidar: LidarRecording, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Range in metres and intensity (66, 1030) float32 of a training scan, projected as the papers do."""
    sweeps, a = lidar.sweeps, lidar.sweeps.arrays
    part = sweeps.returns_of(int(np.flatnonzero(sweeps.is_training)[number]))
    return _PANO.project(a["points_m"][part], a["intensity"][part])


def _score(
    render: RayRenderer, recipe: ResidualRecipe, lidar: LidarRecording, number: int,
    truth: tuple[np.ndarray, np.ndarray],
) -> list[float]:  # fmt: skip
    """The values of `_METRICS` of a training scan that is simulated as if it were held out."""
    prior = lidar.evidence.prior
    rays, rendered = fire_left_out(render, recipe, lidar, number)
    points_m, intensity, _ = RenderedSweep.of(rays, rendered).scan()
    shown = _PANO.project(points_m, intensity)
    found = {
        **point_cloud_metrics(_PANO.points(shown[0]), _PANO.points(truth[0])),
        **range_image_metrics(shown[0], truth[0]),
        **intensity_image_metrics(shown[1], truth[1]),
    }
    expected = np.isfinite(rendered.range_m) & rays_return(rendered.hit)
    returned = prior.is_hit[number, rays.laser, prior.nearest_firing(number, rays.fraction)]
    return [*(found[name].value for name in list(_METRICS)[:-1]), float((expected == returned).mean())]


def fire_left_out(
    render: RayRenderer, recipe: ResidualRecipe, lidar: LidarRecording, number: int,
    correct: SweepCorrector | None = None,
) -> tuple[SweepRays, RenderedRays]:  # fmt: skip
    """Simulate a training scan as if it were held out.

    Args:
        render: Without that scan's returns.
        recipe: Says how many scans give the hit prior.
        lidar: The recording.
        number: Of the scan among the training scans.
        correct: Corrects the rendered sweep, if any.
    """
    time_s = float(lidar.evidence.prior.time_s[number])
    plan = recorded_sweep(lidar.sweeps.table, time_s)
    model = SceneModel(lidar=render, camera=None, prior_scans=recipe.evidence.votes, correct=correct)
    return fire_sweep(model, lidar, plan, time_s, leave_out_s=time_s)


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
