"""The LiDAR field of the residual family: its training rays and training; its comparison with `reproject`."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import torch

from nvsf_core._types import Scalar
from nvsf_core.errors import DataError
from nvsf_core.evidence.moving.objects import objects_at
from nvsf_core.fields.lidar_field import LidarField, object_surfaces
from nvsf_core.kernels.threads import in_parts
from nvsf_core.models.family import TrainedPart, TrainingSession, fit, training_device
from nvsf_core.models.holdout import SCAN_METRICS, compare, left_out_renderer, score_left_out
from nvsf_core.models.residual.lidar_step import (
    LidarBatch,
    LidarRays,
    join_rays,
    lidar_step,
    sampled_batch,
)
from nvsf_core.recipe import ResidualRecipe
from nvsf_core.recording.drive import LidarRecording
from nvsf_core.rendering.reproject import NEAR_M
from nvsf_core.sensors.beam_table import corrected_rays
from nvsf_core.simulation.ray_renderers import field_renderer
from nvsf_core.training.ahead import Ahead
from nvsf_core.training.loop import Step, fresh_state, side_by_side

SHOWS_FIELD = "lidar_shows_field"
"""Name of the fact: whether the field beat `reproject` on the validation scans."""


def _dropped_rays(lidar: LidarRecording, number: int, near_scans: np.ndarray) -> tuple[LidarRays, np.ndarray]:
    """Dropped rays of a training scan (empty cells of lasers and firings), and their times (n,) in s.

    They have their lasers' nominal angles at the time of the firing.
    """
    sweeps, prior, lasers = lidar.sweeps, lidar.evidence.prior, lidar.evidence.lasers
    table = sweeps.table
    laser_row, firing = np.nonzero(~prior.is_hit[number][lasers][:, : prior.firings_of(number)])
    laser = lasers[laser_row].astype(np.int64)
    when = prior.fraction[number][firing].astype(np.float64)
    shift = (table.phase_steps - table.firing_shift_steps)[laser] * table.step_rad
    origin, direction = corrected_rays(table, -2.0 * np.pi * when + shift, laser)
    fired_s = prior.time_s[number] + when * sweeps.period_s
    origin, direction = sweeps.trajectory.move_rays(origin, direction, fired_s)
    nothing = np.zeros(len(laser), np.float32)
    hit_prior = prior.hit_prior(laser, when, near_scans)
    rays = LidarRays(origin.astype(np.float32), direction.astype(np.float32), nothing, nothing, hit_prior)
    return rays, fired_s


def training_rays(lidar: LidarRecording, recipe: ResidualRecipe, field: LidarField) -> LidarRays:
    """Returns and dropped rays of `learned_scans`, with hit priors and moving objects of the other scans.

    Raises:
        DataError: There is no ray.
    """
    sweeps, evidence = lidar.sweeps, lidar.evidence
    alone = int((~evidence.prior.is_unidentified).sum()) == 1
    learned = learned_scans(lidar)

    def rays_of(place: int) -> list[LidarRays]:
        number, scan = learned[place]
        time_s = float(sweeps.arrays["time_s"][scan])
        prior_scans = evidence.prior.nearest_scans(
            time_s, recipe.evidence.votes, leave_out_s=None if alone else time_s
        )
        both = (_returned_rays(lidar, scan, prior_scans), _dropped_rays(lidar, number, prior_scans))
        return [rays for rays, _ in both] if evidence.dynamic is None else _meet(lidar, field, number, both)

    joined = join_rays([rays for both in in_parts(rays_of, len(learned)) for rays in both])
    if len(joined) == 0:
        raise DataError(
            f"field: expected LiDAR rays to train on, found none in {len(learned)} training scans: no "
            "return that is not the own vehicle's, and no firing that was dropped"
        )
    return joined


def learned_scans(lidar: LidarRecording) -> list[tuple[int, int]]:
    """Training scans to learn from: the number among training scans, and among all scans.

    Validation scans are left out, and scans without known lasers, whose dropped rays are not known.
    """
    left_out, is_learned = lidar.evidence.left_out, ~lidar.evidence.prior.is_unidentified
    if left_out is not None:
        is_learned[left_out.validation] = False
    training = np.flatnonzero(lidar.sweeps.is_training)
    return [(number, int(training[number])) for number in np.flatnonzero(is_learned).tolist()]


def _returned_rays(lidar: LidarRecording, scan: int, near_scans: np.ndarray) -> tuple[LidarRays, np.ndarray]:
    """A scan's returns without the own vehicle's, and their times (n,) in s."""
    sweeps, a = lidar.sweeps, lidar.sweeps.arrays
    part = sweeps.returns_of(scan)
    kept = lidar.sweeps.is_of_world(part) & (a["laser"][part] >= 0)
    fraction = a["sweep_fraction"][part][kept]
    rays = LidarRays(
        a["origin_m"][part][kept], a["direction"][part][kept], a["range_m"][part][kept],
        sweeps.even_intensity(part)[kept],
        lidar.evidence.prior.hit_prior(a["laser"][part][kept], fraction, near_scans),
    )  # fmt: skip
    return rays, float(a["time_s"][scan]) + fraction.astype(np.float64) * sweeps.period_s


def _meet(
    lidar: LidarRecording, field: LidarField, number: int, both: tuple[tuple[LidarRays, np.ndarray], ...]
) -> list[LidarRays]:
    """Rays of a training scan with the moving objects on their way, from the evidence of the other scans."""
    evidence = lidar.evidence
    assert evidence.dynamic is not None
    objects, places = evidence.dynamic.objects, field.places(evidence.dynamic.objects)
    time_s = float(evidence.prior.time_s[number])
    there = objects_at(objects, time_s, lidar.object_hit_priors, leave_out=number)
    return [
        replace(
            rays,
            objects=object_surfaces(
                there, places, rays.origin_m, rays.direction, fired_s, near_m=NEAR_M, far_m=lidar.far_m
            ),
        )
        for rays, fired_s in both
    ]


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
    with _steps(field, rays, recipe, lidar) as step:
        fit(session, "lidar", state, spec, step)
    field.to("cpu")
    validating = time.perf_counter()
    shows_field, verdict = choose(field, recipe, lidar)
    preparation += time.perf_counter() - validating
    session.say("lidar", f"shows {verdict['lidar_shows']}")
    return TrainedPart(
        states={"lidar": state}, preparation_seconds=preparation,
        metadata={"training_rays": len(rays), **verdict}, facts={SHOWS_FIELD: shows_field},
    )  # fmt: skip


@contextmanager
def _steps(
    field: LidarField, rays: LidarRays, recipe: ResidualRecipe, lidar: LidarRecording
) -> Iterator[Step]:
    """The steps of a training: on the CPU in parts that threads compute, on a GPU as one batch of all parts.

    Each of a GPU's operations takes as long for a part of the rays as for all; what the CPU has to find for
    a batch it finds ahead.
    """
    spec, device = recipe.lidar_training, next(field.parameters()).device

    def sampled(own: Sequence[torch.Generator]) -> LidarBatch:
        return sampled_batch(lidar.evidence.static, rays, recipe, lidar.far_m, own)

    if device.type == "cpu":
        yield lambda _, generator: side_by_side(
            spec.parts, generator, lambda own: lidar_step(field, sampled([own]), recipe)
        )
        return
    with Ahead(spec.parts, sampled) as ahead:
        yield lambda _, generator: [lambda: [lidar_step(field, ahead.take(generator).to(device), recipe)]]


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

    def by_field(number: int) -> list[float]:
        render = field_renderer(
            field, left_out.static, lidar.moving(leave_out=number),
            most=recipe.evidence.lidar_candidates, far_m=lidar.far_m,
        )  # fmt: skip
        return score_left_out(render, votes, lidar, number)

    def by_evidence(number: int) -> list[float]:
        render = left_out_renderer(lidar, left_out, number)
        return score_left_out(render, votes, lidar, number)

    found = compare(SCAN_METRICS, numbers, {"field": by_field, "reproject": by_evidence})
    shows_field = found.wins("field", "reproject")
    figures = found.figures({"field": "lidar_judged_", "reproject": "lidar_judged_reproject_"})
    shown = "field" if shows_field else "reproject: learning did not beat it"
    return shows_field, {"lidar_shows": shown, **figures}
