"""The rays that a residual field is trained on, with what the other scans say of each."""

from dataclasses import replace

import numpy as np

from nvsf_core.errors import DataError
from nvsf_core.evidence.moving.objects import objects_at
from nvsf_core.fields.lidar_field import LidarField
from nvsf_core.fields.object_surfaces import object_surfaces
from nvsf_core.models.residual.training.lidar_rays import LidarRays, dropped_rays, join_rays
from nvsf_core.recipe import ResidualRecipe
from nvsf_core.recording.drive import LidarRecording
from nvsf_core.rendering.reproject import NEAR_M


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
