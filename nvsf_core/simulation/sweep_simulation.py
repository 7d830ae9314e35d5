"""Simulation of one LiDAR sweep: rays rendered, the scan as a sensor records it, its pano, their support."""

from dataclasses import dataclass

import numpy as np

from nvsf_core.evidence.scene_evidence import SceneEvidence
from nvsf_core.evidence.surfels import Surfels
from nvsf_core.kernels.ray_agreement import add_agreement, holds_points
from nvsf_core.recording.drive import LidarRecording, ScanLookups, ray_ends_m
from nvsf_core.rendering.rendered import RenderedRays, Support
from nvsf_core.sensors.linear_pano import LinearPano
from nvsf_core.sensors.own_vehicle import NEAR_M
from nvsf_core.sensors.sweep import SweepRays, sweep_rays
from nvsf_core.sensors.tables import LaserTable
from nvsf_core.simulation.footprint import render_beams
from nvsf_core.simulation.hits_elsewhere import SCANS, hit_prior_elsewhere
from nvsf_core.simulation.mirrored import add_mirrored
from nvsf_core.simulation.ray_renderers import render_in_chunks
from nvsf_core.simulation.scan import (
    RenderedSweep,
    by_lasers,
    measured_when_stationary,
    put_back_own_vehicle,
    returns_of_sweep,
)
from nvsf_core.simulation.scene_model import SceneModel
from nvsf_core.simulation.unmet import copy_unmet
from nvsf_core.simulation.view_plan import SweepPlan

_AGREEING_SCANS = 2
_SHIFT_M = 0.15
"""A field moves a return along its ray by no more than this from the surface that it was recorded on."""


@dataclass(frozen=True, slots=True)
class SimulatedSweep:
    """The scan of one simulated sweep, its pano, and its rendered grid."""

    points_m: np.ndarray
    """(m, 3) float32, metres, sensor's frame at firing time; laser by laser, azimuth ascending."""
    intensity: np.ndarray
    """(m,) float32, 0..1."""
    laser: np.ndarray
    """(m,) int16, row of the sensor's table."""
    pano_range_m: np.ndarray
    """(66, 1030) float32, metres, 0 = empty: the scan projected as the authors' code does."""
    pano_intensity: np.ndarray
    """(66, 1030) float32, 0..1."""
    pano_hit: np.ndarray
    """(66, 1030) float32, 0..1: probability that any ray of the pixel returns."""
    grid: dict[str, np.ndarray]
    """`GRID_ARRAYS` (l, f) of all rays, before returns are decided or sampled."""
    support: np.ndarray
    """(m,) uint8, `Support` of the scan's returns."""
    grid_support: np.ndarray
    """(l, f) uint8, `Support` of all rays, with a return or without."""


def simulate_sweep(
    model: SceneModel, lidar: LidarRecording, plan: SweepPlan, time_s: float
) -> SimulatedSweep:
    """Simulate one sweep of the plan's sensor; arguments as of `fire_sweep`."""
    near = _near_scans(model, lidar, plan, time_s)
    lookups = ScanLookups(lidar.scan_grids, near, gaps_hide=not plan.is_recorded_sensor)
    rays, rendered = fire_sweep(model, lidar, plan, time_s, lookups=lookups)
    sweep = RenderedSweep.of(rays, rendered)
    returns = sweep.returns()
    points, intensity, laser = sweep.scan(returns)
    pano = LinearPano(reference_quirks=True)
    pano_range, pano_intensity = pano.project(points, intensity)
    fired_s = plan.fired_s(time_s, rays.elapsed, lidar.sweeps.period_s)
    support = support_of_sweep(lidar, rays, rendered, fired_s, lookups, is_own_unit=plan.is_recorded_sensor)
    return SimulatedSweep(
        points, intensity, laser, pano_range, pano_intensity, sweep.pano_hit(pano), sweep.grid(),
        support[returns], support.reshape(rays.shape),
    )  # fmt: skip


def _near_scans(
    model: SceneModel, lidar: LidarRecording, plan: SweepPlan, time_s: float, leave_out_s: float | None = None
) -> np.ndarray:
    """Numbers (k,) of the training scans that give a sweep's hit prior."""
    prior, near_s = lidar.evidence.prior, plan.near_time_s(time_s)
    return prior.nearest_scans(near_s, model.prior_scans, leave_out_s=leave_out_s)


def fire_sweep(
    model: SceneModel,
    lidar: LidarRecording,
    plan: SweepPlan,
    time_s: float,
    *,
    phase: float | None = None,
    leave_out_s: float | None = None,
    lookups: ScanLookups | None = None,
) -> tuple[SweepRays, RenderedRays]:
    """Render all rays of one sweep of the plan's sensor, in the convention of stored scans (`by_lasers`).

    Args:
        model: The scene; its `lidar` is not None.
        lidar: The recording.
        plan: The sensor and its mounting; if it has a path of its own or other moments on it, a plan of this
            instant only (`ViewPlan.only`).
        time_s: The sweep's instant, seconds since the first frame.
        phase: Offset of the firings' azimuths, 0..1 of the step from firing to firing; None = that of the
            recording sensor's scans, one half where they have none, and of other sensors.
        leave_out_s: The training scan of this time is ignored; None = all are used.
        lookups: In the training scans of the hit prior, for whoever asks of the same sweep afterwards; None =
            nobody does.
    """
    assert model.lidar is not None
    evidence, sweeps = lidar.evidence, lidar.sweeps
    near_s = plan.near_time_s(time_s)
    near = _near_scans(model, lidar, plan, time_s, leave_out_s) if lookups is None else lookups.scans
    if plan.is_recorded_sensor:
        lasers, firings = evidence.lasers.astype(np.int64), round(float(evidence.firings[near].mean()))
        usual_phase = lidar.firing_phase
    else:
        lasers, firings = np.arange(plan.table.laser_count), plan.table.firings_per_turn
        usual_phase = 0.5
    rays = sweep_rays(
        plan.table, lasers, firings, plan.path or sweeps.trajectory, plan.moment_s(time_s),
        plan.sweep_s(sweeps.period_s) * plan.path_rate, mount=plan.mount,
        phase=usual_phase if phase is None else phase,
        clock=sweeps.clock_near(near_s) if plan.is_recorded_sensor else None,
    )  # fmt: skip
    fired_s = plan.fired_s(time_s, rays.elapsed, sweeps.period_s)
    is_in_place = plan.is_recorded_sensor and plan.mount is None and plan.is_as_recorded
    if is_in_place:
        hit_prior = evidence.prior.hit_prior_of_sweep(lasers, rays.fraction[:firings], near).reshape(-1)
    else:
        asked = evidence.prior.nearest_scans(near_s, SCANS, leave_out_s=leave_out_s)
        hit_prior = hit_prior_elsewhere(lidar, rays, fired_s, asked, is_own_unit=plan.is_recorded_sensor)
    columns = (rays.origin_m, rays.direction, hit_prior, fired_s)
    if plan.has_footprint:
        rendered = render_beams(model.lidar, *columns, divergence_mrad=plan.table.divergence_mrad)
    else:
        rendered = render_in_chunks(model.lidar, *columns)
    if model.above is not None:
        is_above = _elevation_rad(plan, rays) > highest_rad(sweeps.table, evidence)
        missing = np.flatnonzero(is_above & ~np.isfinite(rendered.range_m))
        if len(missing):
            above = model.above(*(column[missing] for column in columns))
            rendered = rendered.with_rays(missing, above)
    rendered = by_lasers(rendered, rays.laser, plan.table, as_recorded=model.as_recorded)
    if model.correct is not None and is_in_place:
        rendered = model.correct(rays, rendered, lookups or ScanLookups(lidar.scan_grids, near))
    if is_in_place and not model.as_recorded:
        own = None if leave_out_s is None else int(np.abs(evidence.prior.time_s - leave_out_s).argmin())
        rendered = measured_when_stationary(rendered, rays.laser, rays.fraction, lidar, time_s, leave_out=own)
    if plan.is_recorded_sensor:
        rendered = put_back_own_vehicle(rendered, rays, evidence)
    else:
        rendered = within_range(rendered, plan.table.max_range_m)
    if is_in_place and not model.as_recorded:
        rendered = add_mirrored(rendered, rays, lidar, model.lidar, time_s, leave_out_s=leave_out_s)
    if model.copies_unmet and is_in_place:
        rendered = copy_unmet(rendered, rays.laser, rays.fraction, hit_prior, lidar, near)
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
    """Render given rays of a sweep of the recording sensor, in the convention of stored scans (`by_lasers`).

    Args:
        model: The scene; its `lidar` is not None.
        lidar: The recording.
        time_s: Instant of the sweep's pose, seconds since the first frame.
        origin_m: (r, 3) scene-local, metres.
        direction: (r, 3) unit, scene-local axes.
        laser: (r,) row of the recording sensor's table; -1 = unknown.
        fraction: (r,) -azimuth / 2 pi of the rays' firings, -0.5..0.5.
    """
    assert model.lidar is not None
    sweeps, evidence = lidar.sweeps, lidar.evidence
    known = np.maximum(laser, 0)
    near = evidence.prior.nearest_scans(time_s, model.prior_scans)
    hit_prior = evidence.prior.hit_prior(known, fraction, near)
    elapsed = sweeps.clock_near(time_s).elapsed(fraction.astype(np.float64))
    columns = (origin_m, direction, hit_prior, time_s + elapsed * sweeps.period_s)
    rendered = render_in_chunks(model.lidar, *columns)
    rendered = by_lasers(rendered, laser, sweeps.table, as_recorded=model.as_recorded)
    if not model.as_recorded:
        measured = measured_when_stationary(rendered, known, fraction, lidar, time_s)
        # What stationary scans measured is known by laser.
        names = ("range_m", "hit", "intensity")
        rendered = RenderedRays(
            *(np.where(laser >= 0, getattr(measured, name), getattr(rendered, name)) for name in names)
        )
    if model.copies_unmet:
        rendered = copy_unmet(rendered, laser, fraction, hit_prior, lidar, near)
    return rendered


def _elevation_rad(plan: SweepPlan, rays: SweepRays) -> np.ndarray:
    """Elevation (r,) of rays in the path's frame: of a sensor that is not tilted, its lasers' own."""
    elevation_rad = plan.table.elevation_rad[rays.laser]
    if plan.tilt_rad == 0.0:
        return np.asarray(elevation_rad)
    assert plan.mount is not None
    up = rays.recorded_direction @ plan.mount[2, :3]
    return np.asarray(np.arcsin(np.clip(up, -1.0, 1.0)))


def highest_rad(table: LaserTable, evidence: SceneEvidence) -> float:
    """Elevation of the highest recorded laser in the sensor's table; infinite where no laser is known."""
    looked = table.elevation_rad[evidence.lasers.astype(np.int64)]
    return float(looked.max()) if len(looked) else np.inf


def within_range(rendered: RenderedRays, max_range_m: float) -> RenderedRays:
    """The rays as a sensor records them that has no return from beyond its greatest range.

    What lies beyond the recording sensor's own range is not in the scene: a longer one changes nothing.
    """
    beyond = np.flatnonzero(np.isfinite(rendered.range_m) & (rendered.range_m > max_range_m))
    if len(beyond) == 0:
        return rendered
    nothing = np.zeros(len(beyond), np.float32)
    return rendered.with_rays(beyond, RenderedRays(nothing + np.float32(np.inf), nothing, nothing))


def support_of_sweep(
    lidar: LidarRecording, rays: SweepRays, rendered: RenderedRays, time_s: np.ndarray, lookups: ScanLookups,
    *, is_own_unit: bool,
) -> np.ndarray:  # fmt: skip
    """Support (r,) uint8, values of `Support`, of all rays of a sweep: whether recorded rays like them agree.

    A ray shows a return or none. Of the nearest scans those tell that looked at its end and were not kept
    from it by something nearer. The ray is *seen* if two recorded the same there, from about the same
    direction and distance, and none something else: agreement says most about a ray's error. It is *guessed*
    if its end is where no return was ever recorded, as where images answer; or, of a ray without an end, if
    no scan looked that way. All else is *extrapolated*.

    Args:
        lidar: The recording.
        rays: All r rays.
        rendered: What they show.
        time_s: (r,) seconds since the first frame, when each ray is fired.
        lookups: In the training scans that are asked.
        is_own_unit: Whether the recorded unit fires them: its gaps and its own vehicle are known.
    """
    has_end = np.isfinite(rendered.range_m)
    ends_m = ray_ends_m(rays, rendered.range_m)
    returned = returns_of_sweep(rays, rendered)
    agreed, others = np.zeros((2, len(ends_m)), np.float32)
    looked = np.zeros(len(ends_m), bool)
    for found, scan in zip(lookups.at(ends_m), lookups.scans.tolist(), strict=True):
        position_m = lookups.scan_grids.position_m(scan)
        add_agreement(
            ends_m, rays.direction, rendered.range_m, returned, position_m, found, agreed, others, looked
        )
    is_known = np.where(has_end, _is_recorded(lidar.evidence, rays, ends_m), looked)
    ended = np.flatnonzero(has_end & ~is_known)
    is_known[ended] = _is_on_object(lidar, rays, time_s, ended, ends_m[ended])
    support = np.where(is_known, Support.EXTRAPOLATED, Support.GUESSED)
    support[(agreed >= min(_AGREEING_SCANS, len(lookups.scans))) & (others == 0)] = Support.SEEN
    if is_own_unit:
        support[has_end & (rendered.range_m < NEAR_M)] = Support.SEEN
    return np.asarray(support.astype(np.uint8))


def _is_recorded(evidence: SceneEvidence, rays: SweepRays, ends_m: np.ndarray) -> np.ndarray:
    """Whether (r,) bool a return was recorded in the voxel that a ray ends in, just before or behind it."""
    found = _holds(evidence.static, ends_m)
    for shift_m in (-_SHIFT_M, _SHIFT_M):
        found |= _holds(evidence.static, ends_m + shift_m * rays.direction)
    return found


def _is_on_object(
    lidar: LidarRecording, rays: SweepRays, time_s: np.ndarray, ended: np.ndarray, ends_m: np.ndarray
) -> np.ndarray:
    """Whether (n,) bool the rays `ended` (n,) of a sweep end within a voxel of a moving object's surface.

    Arguments as of `support_of_sweep`; `ends_m` (n, 3) are these rays' ends, scene-local.
    """
    found, moving = np.zeros(len(ends_m), bool), lidar.moving()
    if moving is None or len(ends_m) == 0:
        return found
    # Asked for the whole sweep, whose objects are there already: building others takes longer than the rest.
    for one in moving.at(time_s, rays.origin_m):
        place_m = one.path.to_object(ends_m.astype(np.float64), time_s[ended])
        found |= _holds(one.surfels, place_m, reach=1)
    return found


def _holds(surfels: Surfels, points_m: np.ndarray, reach: int = 0) -> np.ndarray:
    """Whether (n,) bool points (n, 3) lie in the voxel of a surfel, or at most `reach` voxels beside it."""
    return np.asarray(holds_points(points_m, surfels.index, reach))
