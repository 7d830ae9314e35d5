"""From answered rays to a scan as a driver records it."""

from dataclasses import replace

import numpy as np

from nvsf_core.evidence.raydrop.stationary_scans import FiredRays, answer_at_rest
from nvsf_core.evidence.scene_evidence import SceneEvidence
from nvsf_core.rendering.answers import RayAnswers
from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.sensors.tables import LaserTable
from nvsf_core.simulation.lidar_rays import SweepRays

HIT_THRESHOLD = 0.5
"""A tie of the votes is a return: counting ties as drops costs range PSNR."""

_TYPICAL_OWN_RANGE_M = 2.0
"""Where a laser's ray is taken to meet the own vehicle when its azimuth is looked up."""


def measured_at_rest(
    answers: RayAnswers,
    laser: np.ndarray,
    fraction: np.ndarray,
    evidence: SceneEvidence,
    instant_s: float,
    trajectory: Trajectory,
    period_s: float,
    *,
    leave_out: int | None = None,
) -> RayAnswers:
    """Let rays (laser, fraction: (r,)) of the recording sensor's sweep that were fired before say so.

    The same `answers` where the sensor never stood or crawled; the training scan `leave_out` is silent.
    """
    if evidence.at_rest is None:
        return answers
    rays = FiredRays(laser, fraction, answers.range_m, answers.hit, answers.intensity)
    return RayAnswers(
        *answer_at_rest(
            evidence.at_rest, evidence.prior, rays, instant_s, trajectory, period_s,
            leave_out=leave_out,
        )
    )  # fmt: skip


def by_lasers(answers: RayAnswers, laser: np.ndarray, table: LaserTable, *, as_recorded: bool) -> RayAnswers:
    """Answers in the terms of a stored scan: intensities with their laser's gain, ranges without its bias.

    Args:
        answers: Of r rays.
        laser: (r,) of the table; -1 = unknown, which has neither.
        table: Gains and biases.
        as_recorded: Whether the answers hold both already, as `SceneModel` says: then the bias is taken off.
            Else they hold neither, and the gain is applied.
    """
    known = laser >= 0
    if as_recorded:
        bias_m = np.where(known, table.range_bias_m[laser], 0.0)
        return replace(answers, range_m=(answers.range_m - bias_m).astype(np.float32))
    gain = np.where(known, table.intensity_gain[laser], 1.0)
    return replace(answers, intensity=np.clip(answers.intensity * gain, 0.0, 1.0).astype(np.float32))


def put_back_own_vehicle(answers: RayAnswers, rays: SweepRays, evidence: SceneEvidence) -> RayAnswers:
    """Let rays that met the recording car in most training scans meet it again."""
    cells = evidence.own_range_m.shape[1]
    # Most lasers look over the car: theirs are not asked.
    asked = np.flatnonzero(evidence.own_range_m.max(axis=1)[rays.laser] > 0)
    laser = rays.laser[asked]
    origin, direction = rays.recorded_origin_m[asked], rays.recorded_direction[asked]
    # The car was learned by azimuth and distance seen from the sensor's centre, not from the laser.
    nearby = origin + direction * _TYPICAL_OWN_RANGE_M
    azimuth = np.arctan2(nearby[:, 1], nearby[:, 0]) % (2 * np.pi)
    cell = np.floor(azimuth / (2 * np.pi) * cells).astype(np.int64) % cells
    own_m = evidence.own_range_m[laser, cell]
    along = np.einsum("ni,ni->n", origin, direction)
    inside = along**2 - np.einsum("ni,ni->n", origin, origin) + own_m.astype(np.float64) ** 2
    is_own = (own_m > 0) & (inside > 0)
    met = asked[is_own]
    range_m, hit, intensity = (
        column.astype(np.float32) for column in (answers.range_m, answers.hit, answers.intensity)
    )
    range_m[met] = np.sqrt(inside[is_own]) - along[is_own]
    hit[met] = 1.0
    intensity[met] = evidence.own_intensity[laser[is_own], cell[is_own]]
    return RayAnswers(range_m=range_m, hit=hit, intensity=intensity)
