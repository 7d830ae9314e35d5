"""Metrics of the demo's views against the exact truth of its synthetic world.

The truth of a view is the noise-free scan of the same sensor at the view's instants, at the exact position of
the demo's car (by its formula, not the drive's poses), with the own vehicle around the recorded sensor. It is
computed along the view's own rays, so that the unknown phase of a sweep does not matter. A ray returns in
truth if the demo's drop model gives it a probability of at least 1/2; range noise and mixed pixels are left
out. Rows have the protocol `raw` and the view's name as `split`: range errors on the rays that return in
truth, hits on all of the view's rays (not on the recording sensor's grid of 2000 cells), Chamfer and F-score
of the exported scan against the noise-free one; in the region `foreground`, errors of the rays that meet a
moving object in truth.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nvsf_core.demo.drive import DEMO_SEQUENCE
from nvsf_core.demo.lidar import ExactRays, exact_rays
from nvsf_core.demo.motion import FRAME_PERIOD_S
from nvsf_core.demo.world import DemoWorld
from nvsf_core.drives.catalogue import ViewEntry
from nvsf_core.errors import StoreError
from nvsf_core.geometry.se3 import pose_from_parts, transform_points
from nvsf_core.metrics.foreground import FOREGROUND
from nvsf_core.metrics.hit import hit_image_metrics
from nvsf_core.metrics.measure import Measure
from nvsf_core.metrics.point_cloud import point_cloud_metrics, point_cloud_part_metrics
from nvsf_core.metrics.protocols import Scan, near_returns
from nvsf_core.metrics.range_and_intensity import ray_intensity_metrics, ray_range_metrics
from nvsf_core.rendering.rendered import SUPPORTED, Support
from nvsf_core.sensors.beam_table import firing_grid, sensor_rays
from nvsf_core.sensors.tables import sensor_table
from nvsf_core.simulation.view_plan import ViewPlan, table_of
from nvsf_core.stages.inputs import scene_frame
from nvsf_core.stages.runner.stage import Task
from nvsf_core.stages.scoring.lidar import part
from nvsf_core.stages.scoring.rows import Ledger
from nvsf_core.stages.views.view import stored_plan
from nvsf_core.stores.arrays import holds_array, read_arrays, read_attrs

_GRID = ("grid_range_m", "grid_hit", "grid_intensity", "grid_azimuth_rad", "grid_elevation_rad")
_VIEW = (
    "frame", "time_s", "offsets", "points_m", "intensity", "laser", "lidar_render_seconds", "grid_firings",
    *_GRID,
)  # fmt: skip
_COPY = "copy_nearest"
_EVEN_CHANCE = 0.5
"""Truth and rendered probability are compared at this one, whichever threshold a simulated scan has."""
_SAMPLE = 4000
_LARGEST_GAP_M = 0.05
_LARGEST_TURN_RAD = 1e-3


@dataclass(frozen=True, slots=True)
class DemoTruth:
    """The world that a drive of the demo writer was recorded in."""

    world: DemoWorld
    recorded_sensor: str
    lasers: np.ndarray
    """(L,) int64 lasers of the drive, as rows of the recorded sensor's table."""
    period_s: float
    """Duration of a sweep."""
    shift_s: float
    """World time at the drive's time 0."""
    gap_m: float
    """Median |recorded - exact range| of one scan: only the range noise if this is the drive's world."""

    def path_to_world(self, plan: ViewPlan, moments_s: np.ndarray) -> np.ndarray:
        """(k, 4, 4) exact poses of a stored view's path at some of its moments (k,), without its mounting."""
        if plan.path is None:
            return self.world.lidar_to_world(moments_s + self.shift_s)
        return pose_from_parts(*plan.path.at(moments_s))

    @property
    def is_of_this_drive(self) -> bool:
        """Whether the drive was recorded in this world."""
        return self.gap_m < _LARGEST_GAP_M


def read_demo_truth(task: Task) -> DemoTruth | None:
    """The exact truth of the drive; None for a drive that is not the demo's."""
    path = task.store.path("sweeps") / "returns.zarr"
    if task.scene.sequence != DEMO_SEQUENCE or not path.is_dir():
        return None
    a, attrs = read_arrays(path, "frame", "time_s", "offsets"), read_attrs(path)
    if a["frame"].size == 0 or not attrs["lasers"]:
        return None
    world, period_s = DemoWorld(), float(attrs["sweep_period_s"])
    shift_s = float(np.median(a["frame"] * FRAME_PERIOD_S - a["time_s"]))
    return DemoTruth(
        world=world,
        recorded_sensor=attrs["sensor"],
        lasers=np.array(attrs["lasers"], np.int64),
        period_s=period_s,
        shift_s=shift_s,
        gap_m=_gap_m(path, world, a["time_s"][0] + shift_s, part(a["offsets"], 0), period_s, attrs),
    )


def _gap_m(
    path: Path, world: DemoWorld, time_s: float, cut: slice, period_s: float, attrs: Mapping[str, Any]
) -> float:
    """Median |recorded - exact range| over a sample of the returns `cut` of one scan, metres."""
    a = read_arrays(path, "origin_m", "direction", "range_m", "sweep_fraction", "is_own_vehicle")
    others = np.flatnonzero(~a["is_own_vehicle"][cut]) + cut.start
    taken = others[:: max(1, len(others) // _SAMPLE)]
    if taken.size == 0:
        return np.inf
    scene_to_world = scene_frame(attrs)
    origin_m = transform_points(scene_to_world, a["origin_m"][taken])
    direction = a["direction"][taken].astype(np.float64) @ scene_to_world[:3, :3].T
    times_s = time_s + period_s * a["sweep_fraction"][taken].astype(np.float64)
    exact = world.cast(origin_m, direction, times_s)
    return float(np.median(np.abs(exact.range_m - a["range_m"][taken])))


def measure_demo_view(path: Path, view: ViewEntry, truth: DemoTruth, ledger: Ledger) -> Iterator[str]:
    """Add the rows of one view of the demo; yields progress after each sweep.

    Raises:
        StoreError: The stored rays are not those that the view's sensor fires.
    """
    supports = [name for name in ("support", "grid_support") if holds_array(path, name)]
    a, plan = read_arrays(path, *_VIEW, *supports), stored_plan(path)
    for i, frame in enumerate(a["frame"].tolist()):
        own, firings = part(a["offsets"], i), int(a["grid_firings"][i])
        scan = Scan(points_m=a["points_m"][own], intensity=a["intensity"][own], laser=a["laser"][own])
        grid = {name: a[name][i][:, :firings] for name in _GRID}
        rays = _Rays(truth, view, plan.only(i), grid["grid_hit"].shape[1])
        # A copy lies on the model's rays, with the azimuths of the model's returns: checked with the model.
        if path.stem != _COPY:
            rays.require_same(path, grid)
        found = {"all": _against(rays, grid, near_returns(scan))}
        if rays.meets_mover.any():
            found[FOREGROUND] = _along_rays(rays, grid, rays.meets_mover)
        if "support" in a:
            grid["grid_support"] = a["grid_support"][i][:, :firings]
            found |= _by_support(rays, grid, scan, a["support"][own])
        for region, measures in found.items():
            ledger.add(
                measures, split=view.name, protocol="raw", region=region, sensor="lidar", frame=frame,
                render_seconds=float(a["lidar_render_seconds"][i]),
            )  # fmt: skip
        yield f"sweep {i + 1} of {a['frame'].size}"


class _Rays:
    """The rays of one sweep of a view, (lasers, firings), and their exact truth; sensor's frame, metres."""

    def __init__(self, truth: DemoTruth, view: ViewEntry, plan: ViewPlan, firings: int) -> None:
        table = table_of(view.sensor, sensor_table(truth.recorded_sensor))
        is_recorded = table.name == truth.recorded_sensor
        lasers = truth.lasers if is_recorded else np.arange(table.laser_count)
        azimuth_rad, fraction = firing_grid(table, firings)
        theta_rad = azimuth_rad[lasers]
        after_s = (truth.period_s if table.rate_hz is None else 1.0 / table.rate_hz) * fraction
        time_s = float(plan.time_s[0]) + truth.shift_s + plan.scene_rate * after_s
        path_to_world = truth.path_to_world(plan, plan.moments_s + plan.path_rate * after_s)
        self.origin_m, self.direction = sensor_rays(table, theta_rad, lasers[:, None])
        self.exact: ExactRays = exact_rays(
            truth.world, table, lasers, theta_rad, np.broadcast_to(time_s, theta_rad.shape), mount=plan.mount,
            own_vehicle=is_recorded, path_to_world=path_to_world,
        )  # fmt: skip
        self.returns = (self.exact.chance >= _EVEN_CHANCE) & (self.exact.range_m <= table.max_range_m)
        movers = [mover.object_id for mover in truth.world.street.movers]
        self.meets_mover = self.returns & np.isin(self.exact.instance, movers)

    def points(self, range_m: np.ndarray) -> np.ndarray:
        """(L, F, 3) points at (L, F) ranges along the rays."""
        found: np.ndarray = self.origin_m + self.direction * range_m[..., None]
        return found

    def along(self, centre_m: np.ndarray) -> np.ndarray:
        """Range along each ray, given the distance from the sensor's centre; 0 (no return) becomes inf."""
        lever = (self.origin_m * self.direction).sum(axis=-1)
        square = lever**2 - np.square(self.origin_m).sum(axis=-1) + np.square(centre_m.astype(np.float64))
        range_m: np.ndarray = np.sqrt(np.maximum(square, 0.0)) - lever
        return np.where(centre_m > 0.0, range_m, np.inf)

    def require_same(self, path: Path, grid: Mapping[str, np.ndarray]) -> None:
        """Refuse a stored grid that was rendered along other rays."""
        answered = grid["grid_range_m"] > 0.0
        shape = self.returns.shape
        turned = 0.0
        if shape == answered.shape and answered.any():
            points = self.points(np.where(answered, self.along(grid["grid_range_m"]), 0.0))[answered]
            gap = np.arctan2(points[:, 1], points[:, 0]) - grid["grid_azimuth_rad"][answered]
            turned = float(np.median(np.abs(np.angle(np.exp(1j * gap)))))
        if shape != answered.shape or turned > _LARGEST_TURN_RAD:
            raise StoreError(
                f"{path}: expected rays {shape} of the view's sensor, found {answered.shape}, turned by "
                f"{turned:.4f} rad; run novel_views again"
            )


def _against(rays: _Rays, grid: Mapping[str, np.ndarray], exported: Scan) -> dict[str, Measure]:
    """Metrics of the exported scan and of the rendered grid against the truth."""
    true_m = np.where(rays.returns, rays.exact.range_m, 0.0)
    return {
        **_along_rays(rays, grid, np.ones(rays.returns.shape, bool)),
        **point_cloud_metrics(exported.points_m, rays.points(true_m)[rays.returns]),
    }


def _along_rays(rays: _Rays, grid: Mapping[str, np.ndarray], chosen: np.ndarray) -> dict[str, Measure]:
    """Metrics of the chosen (L, F) rays of the rendered grid against the truth."""
    there = rays.returns & chosen
    predicted_m = rays.along(grid["grid_range_m"])
    answered = np.isfinite(predicted_m[there])
    hits = hit_image_metrics(
        (grid["grid_hit"][chosen] >= _EVEN_CHANCE).astype(np.float64), rays.returns[chosen]
    )  # fmt: skip
    return {
        **ray_range_metrics(predicted_m[there], rays.exact.range_m[there]),
        **ray_intensity_metrics(grid["grid_intensity"][there], rays.exact.intensity[there], answered),
        "hit_accuracy": hits["hit_accuracy"],
        "hit_f_score": hits["hit_f_score"],
    }


def _by_support(
    rays: _Rays, grid: Mapping[str, np.ndarray], scan: Scan, support: np.ndarray
) -> dict[str, dict[str, Measure]]:
    """Metrics by region: of the rays and returns of each support, and of all that are supported.

    `support` (N,) is that of the scan's returns, which here are all, also those beyond the metrics' limit.
    """
    true_m = rays.points(np.where(rays.returns, rays.exact.range_m, 0.0))[rays.returns]
    true_support = grid["grid_support"][rays.returns]
    regions: dict[str, tuple[Support, ...]] = {one.region: (one,) for one in Support}
    regions[SUPPORTED] = (Support.EXTRAPOLATED, Support.SEEN)
    return {
        region: {
            **_along_rays(rays, grid, np.isin(grid["grid_support"], kinds)),
            **point_cloud_part_metrics(
                scan.points_m, true_m, np.isin(support, kinds), np.isin(true_support, kinds)
            ),
        }
        for region, kinds in regions.items()
    }
