"""LiDAR scores of a curve: on a fixed quarter of the pano, and on every fourth recorded ray."""

from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np

from benchmarks.common.compared import SHARE, QuarterPano, recorded_scan, scan_of
from nvsf_core.metrics.protocols import PanoImage, Scan, project_scan
from nvsf_core.recording.drive import LidarRecording
from nvsf_core.rendering.rendered import RenderedRays
from nvsf_core.sensors.linear_pano import LinearPano
from nvsf_core.sensors.sweep import SweepRays, sweep_rays
from nvsf_core.simulation.scan import RenderedSweep, put_back_own_vehicle
from nvsf_core.simulation.scene_model import SceneModel
from nvsf_core.simulation.sweep_simulation import fire_sweep, render_along
from nvsf_core.simulation.view_plan import SweepPlan

_ROUGH_RANGE_M = 20.0
"""Where a ray is taken to end when it is asked which column it falls into."""
WHOLE, SECTORS = LinearPano(reference_quirks=True), QuarterPano(reference_quirks=True, block=32)

Answers = Callable[[int], tuple[PanoImage, np.ndarray]]
"""The LiDAR of a method: of each scored frame its pano, whole, and ranges along every fourth recorded ray."""


def quarter_of_rays(lidar: LidarRecording, plan: SweepPlan, time_s: float, prior_scans: int) -> SweepRays:
    """The rays of one sweep that fall into the chosen columns."""
    evidence, sweeps = lidar.evidence, lidar.sweeps
    near = evidence.prior.nearest_scans(time_s, prior_scans)
    firings = round(float(evidence.firings[near].mean()))
    lasers = evidence.lasers.astype(np.int64)
    path, period_s = sweeps.trajectory, sweeps.period_s
    rays = sweep_rays(plan.table, lasers, firings, path, time_s, period_s, phase=lidar.firing_phase)
    return _only(rays, _in_sectors(rays))


def _in_sectors(rays: SweepRays) -> np.ndarray:
    end = rays.recorded_origin_m + rays.recorded_direction * _ROUGH_RANGE_M
    return np.isin(WHOLE.cells(end)[1], SECTORS.columns)


def _only(rays: SweepRays, kept: np.ndarray) -> SweepRays:
    columns = {field.name: getattr(rays, field.name) for field in fields(rays)}
    chosen = {n: v[kept] for n, v in columns.items() if isinstance(v, np.ndarray) and len(v) == len(kept)}
    return replace(rays, shape=(1, int(kept.sum())), **chosen)


def model_answers(lidar: LidarRecording, plan: SweepPlan, model: SceneModel) -> Answers:
    """The LiDAR of a model that has one."""
    sweeps = lidar.sweeps

    def answer(number: int) -> tuple[PanoImage, np.ndarray]:
        frame, time_s = int(plan.frame[number]), float(plan.time_s[number])
        points, intensity, laser = RenderedSweep.of(*_quarter_sweep(lidar, plan, model, time_s)).scan()
        pano = project_scan(WHOLE, Scan(points_m=points, intensity=intensity, laser=laser))
        a, part = sweeps.arrays, sweeps.returns_of(scan_of(lidar, frame))
        rays = (a[name][part][::SHARE] for name in ("origin_m", "direction", "laser", "sweep_fraction"))
        return pano, render_along(model, lidar, time_s, *rays).range_m

    return answer


def _quarter_sweep(
    lidar: LidarRecording, plan: SweepPlan, model: SceneModel, time_s: float
) -> tuple[SweepRays, RenderedRays]:
    """The chosen columns' rays, rendered; what corrects a sweep is asked about the whole of it."""
    if model.correct is None:
        rays = quarter_of_rays(lidar, plan, time_s, model.prior_scans)
        rendered = render_along(
            model, lidar, time_s, rays.origin_m, rays.direction, rays.laser, rays.fraction
        )
        return rays, put_back_own_vehicle(rendered, rays, lidar.evidence)
    rays, rendered = fire_sweep(model, lidar, plan, time_s)
    kept = _in_sectors(rays)
    return _only(rays, kept), RenderedRays(
        rendered.range_m[kept], rendered.hit[kept], rendered.intensity[kept]
    )


def recorded(lidar: LidarRecording, frame: int) -> tuple[Scan, np.ndarray]:
    """A frame's scan, and the ranges of every fourth of its returns."""
    range_m = lidar.sweeps.arrays["range_m"][lidar.sweeps.returns_of(scan_of(lidar, frame))]
    return recorded_scan(lidar, frame), range_m[::SHARE]
