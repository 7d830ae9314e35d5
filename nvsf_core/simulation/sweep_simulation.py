"""One simulated sweep: every firing answered, the scan as a driver records it, and its range image."""

from dataclasses import dataclass, replace

import numpy as np

from nvsf_core.evidence.scene_evidence import SceneEvidence
from nvsf_core.recording.drive import LidarRecording
from nvsf_core.rendering.rendered import RenderedRays
from nvsf_core.sensors.linear_pano import LinearPano
from nvsf_core.sensors.tables import LaserTable
from nvsf_core.simulation.ray_renderers import render_in_chunks
from nvsf_core.simulation.scan import (
    RenderedSweep,
    SweepRays,
    by_lasers,
    measured_when_stationary,
    put_back_own_vehicle,
    sweep_rays,
)
from nvsf_core.simulation.scene_model import RayRenderer, SceneModel
from nvsf_core.simulation.view_plan import SweepPlan


@dataclass(frozen=True, slots=True)
class SimulatedSweep:
    """What one sweep of a view gave."""

    points_m: np.ndarray
    """(m, 3) float32 in the sensor's frame at each firing; laser by laser, azimuth ascending."""
    intensity: np.ndarray
    """(m,) float32."""
    laser: np.ndarray
    """(m,) int16."""
    pano_range_m: np.ndarray
    """(66, 1030) float32, 0 = empty: the scan projected with the papers' quirks."""
    pano_intensity: np.ndarray
    """(66, 1030) float32."""
    pano_hit: np.ndarray
    """(66, 1030) float32: probability that any ray of the cell returned."""
    grid: dict[str, np.ndarray]
    """Range, hit probability, intensity, azimuth, elevation (l, f) as recorded, before anything is drawn."""


def simulate_sweep(
    model: SceneModel, lidar: LidarRecording, plan: SweepPlan, time_s: float
) -> SimulatedSweep:
    """Fire one sweep of the plan's sensor around `time_s` and record what comes back; as `fire_sweep`."""
    sweep = RenderedSweep.of(*fire_sweep(model, lidar, plan, time_s))
    points, intensity, laser = sweep.scan()
    pano = LinearPano(reference_quirks=True)
    pano_range, pano_intensity = pano.project(points, intensity)
    return SimulatedSweep(
        points, intensity, laser, pano_range, pano_intensity, sweep.pano_hit(pano), sweep.grid()
    )


def fire_sweep(
    model: SceneModel,
    lidar: LidarRecording,
    plan: SweepPlan,
    time_s: float,
    *,
    phase: float = 0.5,
    leave_out_s: float | None = None,
) -> tuple[SweepRays, RenderedRays]:
    """All rays of one sweep of the plan's sensor, answered; the own vehicle is put back.

    Args:
        model: With a LiDAR.
        lidar: What was recorded.
        plan: Which sensor is fired, and from where.
        time_s: The instant of the sweep's pose.
        phase: Where the sweep starts against its firings, 0..1 of one.
        leave_out_s: Do as if the training scan of that time were held out.
    """
    assert model.lidar is not None
    evidence, sweeps = lidar.evidence, lidar.sweeps
    near = evidence.prior.nearest_scans(time_s, model.prior_scans, leave_out_s=leave_out_s)
    if plan.is_recorded_sensor:
        lasers, firings = evidence.lasers.astype(np.int64), round(float(evidence.firings[near].mean()))
    else:
        lasers, firings = np.arange(plan.table.laser_count), plan.table.firings_per_turn
    rays = sweep_rays(
        plan.table, lasers, firings, sweeps.trajectory, time_s, sweeps.period_s, mount=plan.mount, phase=phase
    )
    voters = lasers if plan.is_recorded_sensor else _similar_lasers(plan.table, sweeps.table, evidence)
    hit_prior = evidence.prior.hit_prior_of_sweep(voters, rays.fraction[:firings], near).reshape(-1)
    fired_s = time_s + rays.fraction * sweeps.period_s
    rendered = render_in_chunks(model.lidar, rays.origin_m, rays.direction, hit_prior, fired_s)
    if model.above is not None and not plan.is_recorded_sensor:
        is_above = plan.table.elevation_rad[rays.laser] > highest_rad(sweeps.table, evidence)
        asked = np.flatnonzero(is_above & ~np.isfinite(rendered.range_m))
        seen = model.above(rays.origin_m[asked], rays.direction[asked], hit_prior[asked], fired_s[asked])
        rendered = _with(rendered, asked, seen)
    rendered = by_lasers(rendered, rays.laser, plan.table, as_recorded=model.as_recorded)
    is_in_place = plan.is_recorded_sensor and plan.mount is None
    if model.correct is not None and is_in_place:
        rendered = model.correct(rays, rendered, near)
    if model.unobserved is not None and is_in_place:
        rendered = ask_unobserved(
            rendered,
            model.unobserved,
            rays.origin_m,
            rays.direction,
            hit_prior,
            fired_s,
            rays.laser,
            plan.table,
        )
    if is_in_place and not model.as_recorded:
        own = None if leave_out_s is None else int(np.abs(evidence.prior.time_s - leave_out_s).argmin())
        rendered = measured_when_stationary(rendered, rays.laser, rays.fraction, lidar, time_s, leave_out=own)
    if plan.is_recorded_sensor:
        rendered = put_back_own_vehicle(rendered, rays, evidence)
    return rays, rendered


def render_along(
    model: SceneModel,
    lidar: LidarRecording,
    time_s: float,
    origin_m: np.ndarray,
    direction: np.ndarray,
    laser: np.ndarray,
    fraction: np.ndarray,
) -> RenderedRays:
    """Any rays of the recording sensor's sweep at `time_s`, as it records them, by a model with a LiDAR.

    Args:
        model: With a LiDAR.
        lidar: What was recorded.
        time_s: The instant of the sweep's pose.
        origin_m: (r, 3) scene-local.
        direction: (r, 3) unit, scene-local.
        laser: (r,) of the recording sensor's table; -1 = unknown.
        fraction: (r,) sweeps after the pose's instant.
    """
    assert model.lidar is not None
    sweeps, evidence = lidar.sweeps, lidar.evidence
    known = np.maximum(laser, 0)
    hit_prior = evidence.prior.hit_prior(
        known, fraction, evidence.prior.nearest_scans(time_s, model.prior_scans)
    )
    fired_s = time_s + fraction.astype(np.float64) * sweeps.period_s
    rendered = render_in_chunks(model.lidar, origin_m, direction, hit_prior, fired_s)
    rendered = by_lasers(rendered, laser, sweeps.table, as_recorded=model.as_recorded)
    if model.unobserved is not None:
        rendered = ask_unobserved(
            rendered, model.unobserved, origin_m, direction, hit_prior, fired_s, laser, sweeps.table
        )
    if model.as_recorded:
        return rendered
    return measured_when_stationary(rendered, known, fraction, lidar, time_s)


def highest_rad(table: LaserTable, evidence: SceneEvidence) -> float:
    """Elevation up to which recorded lasers looked; infinite where none of them is known."""
    looked = table.elevation_rad[evidence.lasers.astype(np.int64)]
    return float(looked.max()) if len(looked) else np.inf


def ask_unobserved(
    rendered: RenderedRays,
    unobserved: RayRenderer,
    origin_m: np.ndarray,
    direction: np.ndarray,
    hit_prior: np.ndarray,
    time_s: np.ndarray,
    laser: np.ndarray,
    table: LaserTable,
) -> RenderedRays:
    """Render rays (r, 3) by `SceneModel.unobserved` that met nothing though all nearby scans returned there.

    Args:
        rendered: In the terms of a stored scan, as `by_lasers` gives them.
        unobserved: Of the model.
        origin_m: (r, 3) scene-local.
        direction: (r, 3) unit.
        hit_prior: (r,) share of the nearest scans that returned; what these rays' hits become.
        time_s: (r,) when each ray is fired.
        laser: (r,) of the table; -1 = unknown.
        table: Of the sensor that fires.
    """
    asked = np.flatnonzero(~np.isfinite(rendered.range_m) & (hit_prior >= 1.0))
    if len(asked) == 0:
        return rendered
    found = unobserved(origin_m[asked], direction[asked], hit_prior[asked], time_s[asked])
    return _with(rendered, asked, by_lasers(found, laser[asked], table, as_recorded=False))


def _with(rendered: RenderedRays, asked: np.ndarray, found: RenderedRays) -> RenderedRays:
    """The same answers, but for rays (k,) `asked`, which another renderer found."""
    columns = {name: getattr(rendered, name).copy() for name in ("range_m", "hit", "intensity")}
    for name, column in columns.items():
        column[asked] = getattr(found, name)
    return replace(rendered, **columns)


def _similar_lasers(table: LaserTable, recorded: LaserTable, evidence: SceneEvidence) -> np.ndarray:
    """(l,) the recording sensor's laser that looks most nearly along each simulated one."""
    seen = evidence.lasers.astype(np.int64)
    apart = np.abs(table.elevation_rad[:, None] - recorded.elevation_rad[seen][None, :])
    return seen[apart.argmin(axis=1)]
