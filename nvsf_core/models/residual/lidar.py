"""The LiDAR field of the residual family: its rays, its training, and its comparison with `reproject`."""

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace

import numpy as np
import torch
from torch import Tensor

from nvsf_core._types import Scalar
from nvsf_core.errors import DataError
from nvsf_core.evidence.moving.objects import objects_at
from nvsf_core.evidence.surfels import Surfels
from nvsf_core.fields.lidar_field import (
    LidarField,
    ObjectSurfaces,
    SurfaceBatch,
    join_surfaces,
    object_surfaces,
    surface_batch,
)
from nvsf_core.kernels.threads import in_parts
from nvsf_core.losses.lidar import depth_loss, intensity_loss, raydrop_loss, surface_likelihood
from nvsf_core.losses.total import LossBreakdown, total_loss
from nvsf_core.models.family import TrainedPart, TrainingSession, fit, training_device
from nvsf_core.models.holdout import SCAN_METRICS, compare, left_out_renderer, score_left_out
from nvsf_core.recipe.residual import ResidualRecipe, TrainingSpec
from nvsf_core.recording.drive import LidarRecording
from nvsf_core.rendering.lidar import LidarRender, render_lidar
from nvsf_core.rendering.reproject import NEAR_M
from nvsf_core.sensors.beam_table import corrected_rays
from nvsf_core.simulation.ray_renderers import field_renderer
from nvsf_core.training.ahead import Ahead
from nvsf_core.training.epochs import Epochs
from nvsf_core.training.loop import Part, Step, fresh_state

SHOWS_FIELD = "lidar_shows_field"
"""Name of the fact: whether the field beat `reproject` on the validation scans."""
_EPOCHS, _RAYS_AN_EPOCH = 2.5, 660_000
"""How often a ray is learned from at most: 2.5 times, or once for each so many rays if that is more. A field
that sees few rays again and again learns them by heart, most of all which of them dropped (decision 0054)."""
_ENOUGH_STEPS, _FEWEST_A_STEP = 850, 1024
"""Where rays make fewer steps, a step takes fewer, down to so many: surfaces want steps (decision 0054)."""


@dataclass(frozen=True, slots=True)
class LidarRays:
    """n rays of the training frames, scene-local."""

    origin_m: np.ndarray
    """(n, 3) float32."""
    direction: np.ndarray
    """(n, 3) float32, unit."""
    range_m: np.ndarray
    """(n,) float32, metres; 0 = dropped."""
    intensity: np.ndarray
    """(n,) float32, 0..1; 0 = dropped."""
    hit_prior: np.ndarray
    """(n,) float32: share of the nearest other training scans that have a return there."""
    objects: ObjectSurfaces | None = None
    """Surfaces of moving objects, from the other scans, at these rays' times; None in a static scene."""

    def __len__(self) -> int:
        """Number of rays."""
        return len(self.range_m)


def join_rays(parts: list[LidarRays]) -> LidarRays:
    """Rays of several parts, one after the other; all of a ray lies together in memory, as it is sampled."""
    table = np.empty((sum(len(part) for part in parts), 9), np.float32)
    columns = {
        "origin_m": table[:, :3], "direction": table[:, 3:6], "range_m": table[:, 6],
        "intensity": table[:, 7], "hit_prior": table[:, 8],
    }  # fmt: skip
    for name, column in columns.items():
        np.concatenate([getattr(part, name) for part in parts], out=column)
    objects = [part.objects for part in parts if part.objects is not None]
    joined = join_surfaces(objects, [len(part) for part in parts]) if objects else None
    return LidarRays(**columns, objects=joined)


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
        return [rays for rays, _ in both] if not evidence.objects else _meet(lidar, field, number, both)

    joined = join_rays([rays for both in in_parts(rays_of, len(learned)) for rays in both])
    if (evidence.lasers < 0).all():
        is_found = sweeps.table.name.startswith("found-")
        otherwise = "give each point its `ring`" if is_found else 'write `lidar = "found"`'
        raise DataError(
            f"field: expected scans whose lasers are known, found none in {len(evidence.prior.time_s)}: they "
            f"do not fit a {sweeps.table.name}; name their sensor (`lidar` of the scene), or {otherwise}"
        )
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
    return rays, sweeps.fired_s(scan)[kept]


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
    scan = int(np.flatnonzero(sweeps.is_training)[number])
    fired_s = prior.time_s[number] + sweeps.clock_of(scan).elapsed(when) * sweeps.period_s
    origin, direction = sweeps.trajectory.move_rays(origin, direction, fired_s)
    nothing = np.zeros(len(laser), np.float32)
    hit_prior = prior.hit_prior(laser, when, near_scans)
    rays = LidarRays(origin.astype(np.float32), direction.astype(np.float32), nothing, nothing, hit_prior)
    return rays, fired_s


def _meet(
    lidar: LidarRecording, field: LidarField, number: int, both: tuple[tuple[LidarRays, np.ndarray], ...]
) -> list[LidarRays]:
    """Rays of a training scan with the moving objects on their way, from the evidence of the other scans."""
    objects, places = lidar.evidence.objects, field.places(lidar.evidence.objects)
    time_s = float(lidar.evidence.prior.time_s[number])
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


@dataclass(frozen=True, slots=True)
class LidarBatch:
    """n sampled training rays with the surfaces along them. Its rays' numbers are those in the batch."""

    surfaces: SurfaceBatch
    """Along the n rays."""
    true_range_m: Tensor
    """(n,) float32, metres; 0 = dropped."""
    true_intensity: Tensor
    """(n,) float32, 0..1; 0 = dropped."""
    hit_prior: Tensor
    """(n,) float32, see `LidarRays`."""
    met: Tensor
    """(m,) int64: rays with a surface."""
    returned: Tensor
    """(k,) int64: those of them with a return."""
    meets_object: Tensor | None
    """(k,) bool, of these: whether a surface is a moving object's; None if no surface of the batch is."""

    def to(self, device: torch.device) -> "LidarBatch":
        """The same batch on `device`."""
        meets = None if self.meets_object is None else self.meets_object.to(device)
        names = ("true_range_m", "true_intensity", "hit_prior", "met", "returned")
        tensors = {name: getattr(self, name).to(device) for name in names}
        return LidarBatch(self.surfaces.to(device), **tensors, meets_object=meets)


def batch_of(
    surfels: Surfels, rays: LidarRays, recipe: ResidualRecipe, far_m: float, chosen: Tensor
) -> LidarBatch:
    """Some of the training rays, with the surfaces along them.

    Args:
        surfels: Of the static scene; moving objects come with the rays.
        rays: Of all training scans.
        recipe: Surfaces a ray.
        far_m: How far a ray is followed.
        chosen: (n,) int64 numbers of the rays.
    """
    most, sampled = recipe.evidence.lidar_candidates, chosen.numpy()
    surfaces = surface_batch(
        surfels, rays.origin_m[sampled], rays.direction[sampled], most=most, near_m=NEAR_M, far_m=far_m,
        objects=None if rays.objects is None else rays.objects.of(sampled),
    )  # fmt: skip
    range_m, intensity, hit_prior = (
        torch.from_numpy(column[sampled]) for column in (rays.range_m, rays.intensity, rays.hit_prior)
    )
    met = surfaces.is_there[:, 0]
    returned = (met & (range_m > 0)).nonzero()[:, 0]
    of_object = surfaces.hit_prior >= 0.0
    meets = None
    if bool(of_object.any()):
        meets = surfaces.spread(of_object.float()[:, None])[returned, :, 0].any(dim=1)
    return LidarBatch(surfaces, range_m, intensity, hit_prior, met.nonzero()[:, 0], returned, meets)


def lidar_step(field: LidarField, batch: LidarBatch, recipe: ResidualRecipe) -> LossBreakdown:
    """The loss of a batch of rays, which is a step or a part of one, on the field's device."""
    rendered = render_lidar(field, batch.surfaces, batch.hit_prior)
    # Which rays end on a moving object is known on the device only, and to ask it takes its time.
    corrected = batch.met if batch.meets_object is None else batch.met[~rendered.on_object[batch.met]]
    returned, is_return = batch.returned, (batch.true_range_m > 0).float()
    terms = {
        "depth": _depth(rendered, batch),
        "hit": raydrop_loss(rendered.hit_logit.index_select(0, corrected), is_return[corrected]),
        "intensity": intensity_loss(
            rendered.intensity_logit.index_select(0, returned), batch.true_intensity[returned]
        ),
    }
    return total_loss(terms, asdict(recipe.losses))


def _depth(rendered: LidarRender, batch: LidarBatch) -> Tensor:
    """Depth loss of each ray that returned: weighted range error, on moving objects a likelihood.

    A moving object is thin, met by few rays and mostly edges: there the weights must stay shares of rays.
    """
    of_returns = (
        rendered.weights.index_select(0, batch.returned),
        rendered.range_m.index_select(0, batch.returned),
        batch.true_range_m[batch.returned],
    )
    off_m = depth_loss(*of_returns)
    if batch.meets_object is None:
        return off_m
    return torch.where(batch.meets_object, surface_likelihood(*of_returns), off_m)


def training_for(recipe: ResidualRecipe, rays: int) -> TrainingSpec:
    """The training on so many rays: the recipe's; of few rays, with fewer steps and fewer rays a step."""
    spec = recipe.lidar_training
    drawn = max(_EPOCHS, rays / _RAYS_AN_EPOCH) * rays
    wanted = max(drawn / min(_ENOUGH_STEPS, spec.steps), _FEWEST_A_STEP)
    a_step = min(spec.rays, math.ceil(wanted / spec.parts) * spec.parts)
    return replace(spec, rays=a_step, steps=min(spec.steps, math.ceil(drawn / a_step)))


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
    started = time.perf_counter()
    rays = training_rays(lidar, recipe, field)
    spec = training_for(recipe, len(rays))
    state = fresh_state(field.to(training_device()), spec, session.seed * 2)
    preparation = time.perf_counter() - started
    order = Epochs(len(rays), session.seed)
    with _steps(field, rays, order, replace(recipe, lidar_training=spec), lidar) as step:
        fit(session, "lidar", state, spec, step)
    field.to("cpu")
    validating = time.perf_counter()
    shows_field, verdict = choose(field, recipe, lidar)
    preparation += time.perf_counter() - validating
    session.say("lidar", f"shows {verdict['lidar_shows']}")
    return TrainedPart(
        states={"lidar": state}, preparation_seconds=preparation,
        metadata={"training_rays": len(rays), "lidar_steps": spec.steps, **verdict},
        facts={SHOWS_FIELD: shows_field},
    )  # fmt: skip


@contextmanager
def _steps(
    field: LidarField, rays: LidarRays, order: Epochs, recipe: ResidualRecipe, lidar: LidarRecording
) -> Iterator[Step]:
    """The steps of a training: on the CPU in parts that threads compute, on a GPU as one batch of all parts.

    Each of a GPU's operations takes as long for a part of the rays as for all; what the CPU has to find for
    a batch it finds ahead.
    """
    spec, device = recipe.lidar_training, next(field.parameters()).device

    def batch(chosen: Tensor) -> LidarBatch:
        return batch_of(lidar.evidence.static, rays, recipe, lidar.far_m, chosen)

    def part(number: int) -> Part:
        chosen = order.part(number, spec.rays // spec.parts)
        return lambda: [lidar_step(field, batch(chosen), recipe).scaled(1.0 / spec.parts)]

    if device.type == "cpu":
        yield lambda step, _: [part(step * spec.parts + place) for place in range(spec.parts)]
        return
    with Ahead(lambda step: batch(order.part(step, spec.rays))) as ahead:
        yield lambda step, _: [lambda: [lidar_step(field, ahead.take(step).to(device), recipe)]]


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
