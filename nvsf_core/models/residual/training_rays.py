"""LiDAR rays that a field is trained on: returns and dropped rays of the training scans."""

from dataclasses import dataclass, replace

import numpy as np

from nvsf_core.errors import DataError
from nvsf_core.evidence.moving.objects import objects_at
from nvsf_core.fields.lidar_field import LidarField
from nvsf_core.fields.surface_batch import ObjectSurfaces, join_surfaces, object_surfaces
from nvsf_core.recipe import ResidualRecipe
from nvsf_core.recording.drive import LidarRecording
from nvsf_core.rendering.reproject import NEAR_M
from nvsf_core.sensors.beam_table import corrected_rays


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
    """Rays of several parts, one after the other."""
    names = ("origin_m", "direction", "range_m", "intensity", "hit_prior")
    columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    objects = [part.objects for part in parts if part.objects is not None]
    joined = join_surfaces(objects, [len(part) for part in parts]) if objects else None
    return LidarRays(**columns, objects=joined)


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
    parts = []
    for number, scan in learned_scans(lidar):
        time_s = float(sweeps.arrays["time_s"][scan])
        prior_scans = evidence.prior.nearest_scans(
            time_s, recipe.evidence.votes, leave_out_s=None if alone else time_s
        )
        both = (_returned_rays(lidar, scan, prior_scans), _dropped_rays(lidar, number, prior_scans))
        parts += [rays for rays, _ in both] if evidence.dynamic is None else _meet(lidar, field, number, both)
    joined = join_rays(parts)
    if len(joined) == 0:
        raise DataError(
            f"field: expected LiDAR rays to train on, found none in {len(parts) // 2} training scans: no "
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
