"""Scans of a view: simulated sweeps, ranges along recorded rays, and copies of the nearest training scan."""

import time
from collections.abc import Iterable, Mapping

import numpy as np

from nvsf_core.models.baselines.copy_nearest import copied_ranges, nearest_earlier
from nvsf_core.recording.drive import LidarRecording, Sweeps
from nvsf_core.sensors.linear_pano import LinearPano
from nvsf_core.simulation.ray_renderers import reprojecting_renderer
from nvsf_core.simulation.raydrop import cells_return
from nvsf_core.simulation.scene_model import PanoRenderer, RayRenderer, SceneModel
from nvsf_core.simulation.sweep_simulation import SimulatedSweep, render_along, simulate_sweep
from nvsf_core.simulation.view_plan import SweepPlan, recorded_sweep
from nvsf_core.stages.runner.stage import Task
from nvsf_core.stages.views.view import render_all


def sweep_arrays(
    task: Task, lidar: LidarRecording, plan: SweepPlan, model: SceneModel, method: str
) -> dict[str, np.ndarray]:
    """Simulate all sweeps of a view with a model that has a LiDAR.

    Args:
        task: Task of the stage, for its progress.
        lidar: The recorded LiDAR.
        plan: Sensor and instants of the sweeps.
        model: The model to render with.
        method: Name of the method, for progress.

    Returns:
        Arrays of the data contract of `novel_views`: the joined scans, panos, and grids of rays.
    """

    def simulated(number: int) -> SimulatedSweep:
        return simulate_sweep(model, lidar, plan.only(number), float(plan.time_s[number]))

    sweeps, seconds = render_all(task, simulated, len(plan.time_s), f"{plan.name}, {method}, sweeps")
    arrays = _joined([(s.points_m, s.intensity, s.laser) for s in sweeps])
    arrays["lidar_render_seconds"] = seconds
    for name in ("pano_range_m", "pano_intensity", "pano_hit"):
        arrays[name] = np.stack([getattr(s, name) for s in sweeps])
    shapes = {s.grid["grid_hit"].shape for s in sweeps}
    firings = max(shape[1] for shape in shapes)
    arrays["grid_firings"] = np.array([s.grid["grid_hit"].shape[1] for s in sweeps])
    arrays["support"] = np.concatenate([s.support for s in sweeps])
    grids = [s.grid | {"grid_support": s.grid_support} for s in sweeps]
    for name in grids[0]:
        # Sweeps differ by a firing or two: shorter grids are padded with zeros.
        padded = [np.pad(grid[name], ((0, 0), (0, firings - grid[name].shape[1]))) for grid in grids]
        arrays[name] = np.stack(padded)
    return arrays


def own_panos(task: Task, poses: np.ndarray, plan: SweepPlan, render: PanoRenderer) -> dict[str, np.ndarray]:
    """The panos of a model that renders the range image's own rays; 0 where no return is expected.

    They are `pano_range_m`, `pano_intensity` and `pano_hit`, each (n, H, W), at poses (n, 4, 4) of the LiDAR
    to scene-local, metres.
    """

    def pano(number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        range_m, intensity, hit = render(poses[number], float(plan.time_s[number]))
        expected = cells_return(hit)
        return range_m * expected, intensity * expected, hit

    panos, _ = render_all(task, pano, len(poses), f"{plan.name}, panos")
    names = ("pano_range_m", "pano_intensity", "pano_hit")
    return {name: np.stack(columns) for name, columns in zip(names, zip(*panos, strict=True), strict=True)}


def along_recorded_rays(lidar: LidarRecording, plan: SweepPlan, model: SceneModel) -> dict[str, np.ndarray]:
    """Range (metres) and intensity that a model renders along the recorded returns' rays, for scoring only.

    Ranges are without the lasers' biases, as the recorded ones that they are compared with.
    """
    sweeps = lidar.sweeps
    a = sweeps.arrays
    ranges, intensities = [], []
    for frame, instant in zip(plan.frame, plan.time_s, strict=True):
        part = sweeps.returns_of(int(np.flatnonzero(a["frame"] == frame)[0]))
        rays = (a[name][part] for name in ("origin_m", "direction", "laser", "sweep_fraction"))
        rendered = render_along(model, lidar, float(instant), *rays)
        ranges.append(rendered.range_m)
        intensities.append(rendered.intensity)
    return {
        "ray_offsets": _offsets([len(r) for r in ranges]),
        "ray_range_m": np.concatenate(ranges).astype(np.float32),
        "ray_intensity": np.concatenate(intensities).astype(np.float32),
    }


def copied_scans(lidar: LidarRecording, plan: SweepPlan) -> dict[str, np.ndarray]:
    """Arrays of the nearest training scan of each instant, copied, and its ranges along the recorded rays."""
    sweeps = lidar.sweeps
    a = sweeps.arrays
    pano = LinearPano(reference_quirks=True)
    scans, panos, rays, seconds = [], [], [], []
    for frame, instant in zip(plan.frame, plan.near, strict=True):
        started = time.perf_counter()
        source, firings = _nearest_training(sweeps, float(instant))
        points_m, intensity, laser = a["points_m"][source], a["intensity"][source], a["laser"][source]
        scans.append((points_m, intensity, laser))
        panos.append(pano.project(points_m, intensity))
        seconds.append(time.perf_counter() - started)
        own = sweeps.returns_of(int(np.flatnonzero(a["frame"] == frame)[0]))
        aims = a["points_m"][own], a["laser"][own]
        rays.append(copied_ranges(points_m, laser, a["range_m"][source], intensity, *aims, firings=firings))
    arrays = _joined(scans)
    arrays["pano_range_m"] = np.stack([range_m for range_m, _ in panos])
    arrays["pano_intensity"] = np.stack([intensity for _, intensity in panos])
    arrays["pano_hit"] = (arrays["pano_range_m"] > 0).astype(np.float32)
    arrays["ray_offsets"] = _offsets([len(r) for r, _ in rays])
    arrays["ray_range_m"] = np.concatenate([r for r, _ in rays])
    arrays["ray_intensity"] = np.concatenate([i for _, i in rays])
    arrays["lidar_render_seconds"] = np.array(seconds)
    return arrays


def copied_sweeps(
    lidar: LidarRecording, plan: SweepPlan, grid: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Arrays of the nearest training scan of each instant, copied, and its ranges along a view's own rays.

    Args:
        lidar: The recorded LiDAR.
        plan: Sweeps of the recording sensor, at any mount.
        grid: `grid_azimuth_rad` and `grid_elevation_rad`, both (n, lasers, firings), of the view's rays, with
            the drive's lasers as rows; `grid_firings` (n,), the firings that are not padding.
    """
    a = lidar.sweeps.arrays
    pano = LinearPano(reference_quirks=True)
    lasers, firings = grid["grid_azimuth_rad"].shape[1:]
    laser = np.repeat(lidar.evidence.lasers.astype(np.int64), firings)
    scans, panos, rendered, seconds = [], [], [], []
    for instant, azimuth_rad in zip(plan.near, grid["grid_azimuth_rad"], strict=True):
        started = time.perf_counter()
        source, fired = _nearest_training(lidar.sweeps, float(instant))
        scan = (a["points_m"][source], a["intensity"][source], a["laser"][source])
        towards = np.stack([np.cos(azimuth_rad).ravel(), np.sin(azimuth_rad).ravel()], axis=1)
        centre_m = np.linalg.norm(scan[0], axis=1)
        rendered.append(copied_ranges(scan[0], scan[2], centre_m, scan[1], towards, laser, firings=fired))
        scans.append(scan)
        panos.append(pano.project(scan[0], scan[1]))
        seconds.append(time.perf_counter() - started)
    centre_m, shine = (np.stack(one).reshape(-1, lasers, firings) for one in zip(*rendered, strict=True))
    pano_range_m, pano_intensity = (np.stack(one) for one in zip(*panos, strict=True))
    found = np.isfinite(centre_m)
    return _joined(scans) | {
        "pano_range_m": pano_range_m, "pano_intensity": pano_intensity,
        "pano_hit": (pano_range_m > 0).astype(np.float32),
        "grid_range_m": np.where(found, centre_m, 0.0), "grid_hit": found.astype(np.float32),
        "grid_intensity": shine, "lidar_render_seconds": np.array(seconds),
        **{name: grid[name] for name in ("grid_azimuth_rad", "grid_elevation_rad", "grid_firings")},
    }  # fmt: skip


def _nearest_training(sweeps: Sweeps, time_s: float) -> tuple[slice, int]:
    """The returns of the training scan nearest in time, and its firings."""
    training = np.flatnonzero(sweeps.is_training)
    scan = int(training[nearest_earlier(sweeps.arrays["time_s"][training], time_s)])
    return sweeps.returns_of(scan), int(sweeps.arrays["firings"][scan]) or sweeps.table.firings_per_turn


def warm_up(lidar: LidarRecording, renderers: Iterable[RayRenderer]) -> None:
    """Render a few rays by each, and a whole sweep by `reproject`, which is fast.

    The first sweep of a process loads compiled kernels and arranges the recorded scans for lookups: that must
    not count as the render time of all that follow.
    """
    a = lidar.sweeps.arrays
    count = len(a["origin_m"][:64])
    fired_s = np.full(count, a["time_s"][0], np.float64)
    for render in renderers:
        render(a["origin_m"][:count], a["direction"][:count], np.ones(count, np.float32), fired_s)
    time_s, cheap = float(a["time_s"][0]), SceneModel(lidar=reprojecting_renderer(lidar), camera=None)
    simulate_sweep(cheap, lidar, recorded_sweep(lidar.sweeps.table, time_s), time_s)


def _joined(scans: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> dict[str, np.ndarray]:
    return {
        "offsets": _offsets([len(points) for points, _, _ in scans]),
        "points_m": np.concatenate([points for points, _, _ in scans]),
        "intensity": np.concatenate([intensity for _, intensity, _ in scans]),
        "laser": np.concatenate([laser for _, _, laser in scans]),
    }


def _offsets(lengths: list[int]) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
