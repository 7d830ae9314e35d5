"""LiDAR rays to train on: returns and dropped rays, each with what the other scans show there."""

from dataclasses import dataclass, replace

import numpy as np

from nvsf_core.errors import DataError
from nvsf_core.evidence.moving.objects import objects_at
from nvsf_core.evidence.raydrop.prior import DropPrior
from nvsf_core.fields.lidar_field import LidarField
from nvsf_core.fields.surface_batch import ObjectSurfaces, join_surfaces, object_surfaces
from nvsf_core.recipe import ResidualRecipe
from nvsf_core.recording.drive import LidarRecording
from nvsf_core.rendering.reproject import NEAR_M
from nvsf_core.sensors.beam_table import corrected_rays
from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.sensors.tables import LaserTable


@dataclass(frozen=True, slots=True)
class LidarRays:
    """n rays of the training frames, scene-local."""

    origin_m: np.ndarray
    """(n, 3) float32."""
    direction: np.ndarray
    """(n, 3) float32."""
    range_m: np.ndarray
    """(n,) float32; 0 where nothing returned."""
    intensity: np.ndarray
    """(n,) float32; 0 where nothing returned."""
    hit_prior: np.ndarray
    """(n,) float32: share of the nearest other training scans that returned here."""
    objects: ObjectSurfaces | None = None
    """Moving objects as the other scans prove them, at these rays' times; None where nothing moves."""

    def __len__(self) -> int:
        """Number of rays."""
        return len(self.range_m)


def join_rays(parts: list[LidarRays]) -> LidarRays:
    """One after the other."""
    names = ("origin_m", "direction", "range_m", "intensity", "hit_prior")
    columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    objects = [part.objects for part in parts if part.objects is not None]
    joined = join_surfaces(objects, [len(part) for part in parts]) if objects else None
    return LidarRays(**columns, objects=joined)


def dropped_rays(
    table: LaserTable,
    prior: DropPrior,
    scan: int,
    lasers: np.ndarray,
    trajectory: Trajectory,
    period_s: float,
    near_scans: np.ndarray,
) -> tuple[LidarRays, np.ndarray]:
    """Rays that a training scan fired without a return: the empty cells of its lasers and firings.

    Their angles are the lasers' nominal ones at the firing's own time (n,), which is returned with them.
    """
    fraction = prior.fraction[scan]
    count = int(np.isfinite(fraction).sum())
    laser_row, firing = np.nonzero(~prior.is_hit[scan][lasers][:, :count])
    laser = lasers[laser_row].astype(np.int64)
    when = fraction[firing].astype(np.float64)
    shift = (table.phase_steps - table.firing_shift_steps)[laser] * table.step_rad
    origin, direction = corrected_rays(table, -2.0 * np.pi * when + shift, laser)
    fired_s = prior.time_s[scan] + when * period_s
    origin, direction = trajectory.move_rays(origin, direction, fired_s)
    nothing = np.zeros(len(laser), np.float32)
    hit_prior = prior.hit_prior(laser, when, near_scans)
    rays = LidarRays(origin.astype(np.float32), direction.astype(np.float32), nothing, nothing, hit_prior)
    return rays, fired_s


def training_rays(lidar: LidarRecording, recipe: ResidualRecipe, field: LidarField) -> LidarRays:
    """Returns and drops of `learned_scans`, each with the others' vote and their objects.

    Raises:
        DataError: There is no ray at all.
    """
    sweeps, evidence = lidar.sweeps, lidar.evidence
    alone = int((~evidence.prior.is_unidentified).sum()) == 1
    parts = []
    for number, scan in learned_scans(lidar):
        time_s = float(sweeps.arrays["time_s"][scan])
        prior_scans = evidence.prior.nearest_scans(
            time_s, recipe.evidence.votes, leave_out_s=None if alone else time_s
        )
        both = (
            _returned_rays(lidar, scan, prior_scans),
            dropped_rays(
                sweeps.table, evidence.prior, number, evidence.lasers, sweeps.trajectory, sweeps.period_s,
                prior_scans,
            ),
        )  # fmt: skip
        parts += [rays for rays, _ in both] if evidence.dynamic is None else _meet(lidar, field, number, both)
    joined = join_rays(parts)
    if len(joined) == 0:
        raise DataError(
            f"field: expected LiDAR rays to train on, found none in {len(parts) // 2} training scans: no "
            "return that is not the own vehicle's, and no firing that was dropped"
        )
    return joined


def learned_scans(lidar: LidarRecording) -> list[tuple[int, int]]:
    """Training scans but the judges and the silent: the number among training scans, and among all.

    Where no laser is known, a firing without a return is no drop.
    """
    left_out, is_learned = lidar.evidence.left_out, ~lidar.evidence.prior.is_unidentified
    if left_out is not None:
        is_learned[left_out.validation] = False
    training = np.flatnonzero(lidar.sweeps.is_training)
    return [(number, int(training[number])) for number in np.flatnonzero(is_learned).tolist()]


def _returned_rays(lidar: LidarRecording, scan: int, near_scans: np.ndarray) -> tuple[LidarRays, np.ndarray]:
    """A scan's returns but for the own vehicle's, and when each was fired."""
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
    """Rays of a training scan with the moving objects that they meet, as all scans but theirs prove them."""
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
