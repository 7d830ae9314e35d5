"""Cues on a view's sweeps that need no truth, with the band that recorded scans have among themselves.

The drive is its training scans but a few, evenly spaced, which are left out: each of these against the drive
gives the band.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from nvsf_core.drives.view_parts import SensorEntry
from nvsf_core.geometry.se3 import pose_from_parts, poses_in
from nvsf_core.metrics.trust.cues import (
    AWAY,
    DENSITY,
    GUESSED,
    INCIDENCE,
    INTENSITY,
    LASERS,
    MISSING,
    RANGES,
    SCAN_PATCHES,
    WRONG,
)
from nvsf_core.metrics.trust.drive_distance import DriveCloud
from nvsf_core.metrics.trust.likeness_classifier import distinguished, scan_features
from nvsf_core.metrics.trust.missing_returns import missing_share
from nvsf_core.metrics.trust.scan_statistics import (
    ScanGrid,
    hit_rate_by_laser,
    hits_differ,
    incidence_distance_deg,
    intensity_table,
    range_distance_m,
    returns_by_incidence,
    returns_by_range,
    scan_grid,
    table_distance,
)
from nvsf_core.recording.drive import Sweeps
from nvsf_core.rendering.rendered import Support
from nvsf_core.sensors.beam_table import firing_grid
from nvsf_core.sensors.sweep import Trajectory, compensate, sweep_fraction
from nvsf_core.sensors.sweep_clock import SweepClock
from nvsf_core.sensors.tables import LaserTable
from nvsf_core.simulation.raydrop import rays_return
from nvsf_core.simulation.view_plan import table_of
from nvsf_core.stages.inputs import read_sweeps
from nvsf_core.stages.runner.stage import Task
from nvsf_core.stages.scoring.lidar import part
from nvsf_core.stages.views.view import stored_plan
from nvsf_core.stores.arrays import holds_array, read_arrays, read_attrs

_LEFT_OUT = 4
"""Most training scans that give the band."""
_NEIGHBOURS = 2
"""Training scans, nearest in time, that distributions are compared with, or nearest in place, that prove
returns."""
_NEAR_M, _FAR_M = 3.0, 80.0
"""Nearer is the own vehicle, farther is counted by no metric."""
_VIEW = (
    "frame", "offsets", "points_m", "laser", "lidar_to_world", "grid_support", "grid_firings",
    "grid_range_m", "grid_hit", "grid_intensity", "grid_azimuth_rad", "grid_elevation_rad",
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class ScanTraits:
    """Distributions of one scan, as they are compared."""

    grid: ScanGrid
    by_laser: np.ndarray
    by_range: np.ndarray
    by_incidence: np.ndarray
    intensity: np.ndarray
    patches: np.ndarray

    @classmethod
    def of(cls, grid: ScanGrid) -> "ScanTraits":
        """The traits of a scan."""
        return cls(
            grid, hit_rate_by_laser(grid), returns_by_range(grid), returns_by_incidence(grid),
            intensity_table(grid), scan_features(grid.range_m, grid.intensity),
        )  # fmt: skip

    def apart(self, others: Sequence["ScanTraits"]) -> dict[str, float]:
        """Cues: the distances of this scan's distributions from the mean ones of recorded scans."""
        mean = {
            name: np.mean([getattr(one, name) for one in others], axis=0)
            for name in ("by_laser", "by_range", "by_incidence")
        }
        patches = np.concatenate([one.patches for one in others])
        tables = [table_distance(self.intensity, one.intensity) for one in others]
        return {
            LASERS.name: float(np.abs(self.by_laser - mean["by_laser"]).mean()),
            RANGES.name: range_distance_m(self.by_range, mean["by_range"]),
            INCIDENCE.name: incidence_distance_deg(self.by_incidence, mean["by_incidence"]),
            INTENSITY.name: float(np.mean(tables)),
            SCAN_PATCHES.name: distinguished(self.patches, patches),
        }


class _Rendered(NamedTuple):
    """The exported points of one sweep of a view, and from where they were rendered."""

    points_m: np.ndarray
    """(n, 3) in the sensor's frame at firing time."""
    laser: np.ndarray
    table: LaserTable
    moment_s: float
    """Of the path."""
    lidar_to_world: np.ndarray
    path: Trajectory
    """Where the sensor, or what it is mounted on, goes."""
    sweep_s: float
    """By how much the path's moment changes in a sweep."""
    clock: SweepClock


class RecordedScans:
    """The training scans that views are compared with; their traits and the cloud are made when asked for."""

    def __init__(self, sweeps: Sweeps) -> None:
        """Take the drive's scans; some of those for training are left out of the cloud."""
        self.sweeps, self._traits = sweeps, dict[int, ScanTraits]()
        training = np.flatnonzero(sweeps.is_training).tolist()
        self.scans = [k for k in training if self._is_counted(sweeps.returns_of(k)).any()]
        count = min(_LEFT_OUT, len(self.scans) // 3)
        between = (np.arange(count) + 0.5) * len(self.scans) / max(1, count)
        self.left_out = [self.scans[int(k)] for k in between]

    @property
    def sensor(self) -> str:
        """Name of the recording sensor."""
        return self.sweeps.table.name

    @cached_property
    def has_grid(self) -> bool:
        """Whether it is known which firing of which laser each return of the training scans belongs to."""
        a = self.sweeps.arrays
        returns = [self.sweeps.returns_of(k) for k in self.scans]
        known = all((a["firing"][cut] >= 0).all() and (a["laser"][cut] >= 0).all() for cut in returns)
        return known and bool((a["firings"][self.scans] > 0).all())

    @cached_property
    def cloud(self) -> DriveCloud:
        """The returns of all training scans but those left out, scene-local."""
        return DriveCloud([self._points(k) for k in self.scans if k not in self.left_out])

    def traits(self, scan: int) -> ScanTraits:
        """Traits of a scan, made once."""
        if scan not in self._traits:
            self._traits[scan] = ScanTraits.of(self._grid(scan))
        return self._traits[scan]

    def time_of(self, frame: int) -> float:
        """Time of a frame of the drive, seconds since its first one."""
        a = self.sweeps.arrays
        return float(np.interp(frame, a["frame"], a["time_s"]))

    def neighbours(self, time_s: float, *, leave_out: int | None = None) -> list[ScanTraits]:
        """Traits of the training scans nearest in time."""
        others = [k for k in self.scans if k != leave_out]
        others.sort(key=lambda k: abs(float(self.sweeps.arrays["time_s"][k]) - time_s))
        return [self.traits(k) for k in others[:_NEIGHBOURS]]

    def returns_seen_from(self, lidar_to_world: np.ndarray) -> list[np.ndarray]:
        """Returns (n, 3) of the training scans nearest to a sensor's pose (4, 4), in its frame, metres.

        Points stay where they are in a sweep: the sensor in question moves meanwhile as the recorded one did.
        """
        a = self.sweeps.arrays
        away_m = np.linalg.norm(a["lidar_to_world"][self.scans, :3, 3] - lidar_to_world[:3, 3], axis=1)
        found = []
        for k in np.argsort(away_m, kind="stable")[:_NEIGHBOURS].tolist():
            cut = self.sweeps.returns_of(self.scans[k])
            points_m = a["points_m"][cut][self._is_counted(cut)].astype(np.float64)
            to_sensor = poses_in(lidar_to_world, a["lidar_to_world"][self.scans[k]])
            found.append(points_m @ to_sensor[:3, :3].T + to_sensor[:3, 3])
        return found

    def band(self) -> list[dict[str, float]]:
        """Cues of each left-out scan against the others."""
        found = []
        for scan in self.left_out:
            points_m = self._points(scan)
            cues = {AWAY.name: self.cloud.away(points_m), DENSITY.name: self.cloud.density_aware(points_m)}
            if self.has_grid:
                others = self.neighbours(float(self.sweeps.arrays["time_s"][scan]), leave_out=scan)
                mine = self.traits(scan)
                cues |= mine.apart(others)
                cues[WRONG.name] = float(np.mean([hits_differ(mine.grid, one.grid) for one in others]))
            found.append(cues)
        return found

    def placed(self, scan: _Rendered) -> np.ndarray:
        """(n, 3) scene-local points, metres, of a rendered scan, each moved by the pose of its own time."""
        sweeps = self.sweeps
        kept = _is_counted(scan.points_m)
        points_m, laser = scan.points_m[kept].astype(np.float64), scan.laser[kept]
        path = scan.path
        reference = path.scene_to_world @ pose_from_parts(*path.at(np.array([scan.moment_s])))[0]
        mount = poses_in(reference, scan.lidar_to_world)
        mounted = Trajectory(path.times_s, path.lidar_to_world @ mount, sweeps.trajectory.scene_to_world)
        is_own = scan.table.name == self.sensor
        elapsed = scan.clock.elapsed(sweep_fraction(np.arctan2(points_m[:, 1], points_m[:, 0])))
        origin_m, direction, range_m = compensate(
            scan.table, points_m, laser, scan.moment_s + elapsed * scan.sweep_s, mounted,
            elevation_correction_rad=sweeps.elevation_correction_rad if is_own else None,
        )  # fmt: skip
        return np.asarray(origin_m + direction * range_m[:, None])

    def _points(self, scan: int) -> np.ndarray:
        """(n, 3) scene-local returns of a scan, metres, without the own vehicle."""
        a, cut = self.sweeps.arrays, self.sweeps.returns_of(scan)
        along = a["direction"][cut].astype(np.float64) * a["range_m"][cut, None] + a["origin_m"][cut]
        return np.asarray(along[self._is_counted(cut)])

    def _is_counted(self, cut: slice) -> np.ndarray:
        a = self.sweeps.arrays
        return ~a["is_own_vehicle"][cut] & _is_counted(a["points_m"][cut])

    def _grid(self, scan: int) -> ScanGrid:
        a, cut = self.sweeps.arrays, self.sweeps.returns_of(scan)
        kept = self._is_counted(cut)
        place = a["laser"][cut][kept], a["firing"][cut][kept]
        shape = (self.sweeps.table.laser_count, int(a["firings"][scan]))
        points_m, intensity = np.zeros((*shape, 3)), np.zeros(shape)
        points_m[place], intensity[place] = a["points_m"][cut][kept], a["intensity"][cut][kept]
        return scan_grid(points_m[self.lasers], intensity[self.lasers])

    @cached_property
    def lasers(self) -> np.ndarray:
        """Lasers that ever returned in training, from the top: the rows of a rendered grid."""
        parts = [np.unique(self.sweeps.arrays["laser"][self.sweeps.returns_of(k)]) for k in self.scans]
        found = np.unique(np.concatenate(parts))
        return np.asarray(found[found >= 0])


def read_training_scans(task: Task) -> RecordedScans | None:
    """The drive's training scans; None without any."""
    sweeps = read_sweeps(task.store) if task.store.path("sweeps").is_dir() else None
    found = None if sweeps is None else RecordedScans(sweeps)
    return found if found is not None and found.scans else None


def scan_cues(
    path: Path, recorded: RecordedScans, asked: Mapping[str, str | SensorEntry | None]
) -> Iterator[tuple[int, Mapping[str, float]]]:
    """Cues of each sweep of a stored view of the model: its frame, and cue to value.

    `asked` is the LiDAR that each view of the catalogue asks for; None = the recording one.
    """
    a, attrs = read_arrays(path, *_VIEW), read_attrs(path)
    sensor = str(attrs["sensor"])
    is_comparable = sensor == recorded.sensor and recorded.has_grid
    is_comparable = is_comparable and a["grid_hit"].shape[1] == len(recorded.lasers)
    plan, table = stored_plan(path, attrs), table_of(asked.get(path.parent.name), recorded.sweeps.table)
    goes = plan.path or recorded.sweeps.trajectory
    sweep_s = float(attrs["sweep_period_s"]) * plan.path_rate
    clocks = read_arrays(path, "sweep_clock")["sweep_clock"] if holds_array(path, "sweep_clock") else None
    for i, frame in enumerate(a["frame"].tolist()):
        own, firings, moment_s = part(a["offsets"], i), int(a["grid_firings"][i]), float(plan.moments_s[i])
        scan = _Rendered(
            a["points_m"][own], a["laser"][own], table, moment_s, a["lidar_to_world"][i], goes, sweep_s,
            SweepClock.stored(clocks, i),
        )  # fmt: skip
        points_m = recorded.placed(scan)
        hit = a["grid_hit"][i][:, :firings].astype(np.float64)
        guessed = a["grid_support"][i][:, :firings] == Support.GUESSED
        wrong = np.where(rays_return(hit), 1.0 - hit, hit)
        cues = {
            GUESSED: float(guessed.mean()),
            WRONG.name: float(np.where(guessed, 0.5, wrong).mean()),
            AWAY.name: recorded.cloud.away(points_m),
            DENSITY.name: recorded.cloud.density_aware(points_m),
            MISSING.name: _missing(a, i, table, recorded),
        }
        if is_comparable:
            # Compared with what was recorded near the same place, whatever instant of the scene is shown.
            near_s = moment_s if plan.path is None else recorded.time_of(frame)
            cues |= ScanTraits.of(_rendered_grid(a, i, firings)).apart(recorded.neighbours(near_s))
        yield frame, cues


def _is_counted(points_m: np.ndarray) -> np.ndarray:
    """(n,) bool: points (n, 3) in the sensor's frame that are neither of the own vehicle nor too far."""
    distance_m = np.linalg.norm(points_m, axis=1)
    return np.asarray((distance_m > _NEAR_M) & (distance_m <= _FAR_M))


def _missing(a: Mapping[str, Any], i: int, table: LaserTable, recorded: RecordedScans) -> float:
    """Share of the rays of a rendered sweep, proven to return by recorded scans, that do not.

    A ray without an end has no point to see: its direction is the sensor's own.
    """
    range_m, hit, azimuth_rad, elevation_rad = (
        a[f"grid_{name}"][i, :, : int(a["grid_firings"][i])]
        for name in ("range_m", "hit", "azimuth_rad", "elevation_rad")
    )
    is_own = table.name == recorded.sensor and len(hit) == len(recorded.lasers)
    lasers = recorded.lasers if is_own else np.arange(table.laser_count)
    if len(lasers) != len(hit):
        return math.nan
    met = range_m > 0.0
    azimuth_rad = np.where(met, azimuth_rad, firing_grid(table, hit.shape[1])[0][lasers])
    laser_rad = table.elevation_rad[lasers]
    shown = met.any(axis=1)
    laser_rad[shown] = np.nanmedian(np.where(met, elevation_rad, np.nan)[shown], axis=1)
    near_by_m = recorded.returns_seen_from(a["lidar_to_world"][i])
    returned = rays_return(hit) & met
    return missing_share(azimuth_rad, laser_rad, returned, near_by_m, max_range_m=table.max_range_m)


def _rendered_grid(a: Mapping[str, Any], i: int, firings: int) -> ScanGrid:
    """The returns of a rendered sweep, as they are exported."""
    cut = (i, slice(None), slice(firings))
    range_m, azimuth, elevation = (
        a[f"grid_{name}"][cut].astype(np.float64) for name in ("range_m", "azimuth_rad", "elevation_rad")
    )
    kept = rays_return(a["grid_hit"][cut]) & (range_m > _NEAR_M) & (range_m <= _FAR_M)
    flat = np.cos(elevation)
    direction = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)
    shown = np.where(kept, range_m, 0.0)
    return scan_grid(direction * shown[..., None], np.where(kept, a["grid_intensity"][cut], 0.0))
