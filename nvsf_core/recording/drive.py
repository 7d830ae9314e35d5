"""A recorded drive in memory: its scans by return and by laser and firing, their evidence, images, poses."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nvsf_core.evidence.drop_prior import DropPrior, cells_of, find_cells
from nvsf_core.evidence.moving.object_evidence import ObjectHitPriors
from nvsf_core.evidence.moving.objects import NearObjects
from nvsf_core.evidence.moving.visibility import TimedReturns
from nvsf_core.evidence.scene_evidence import SceneEvidence
from nvsf_core.kernels.scan_lookup import BESIDE, EMPTY, SAME, Lasers, SweepGrid, look_up_scans
from nvsf_core.recording.images import CameraRecording
from nvsf_core.sensors.bonnet import Bonnet
from nvsf_core.sensors.sweep import SweepRays, Trajectory
from nvsf_core.sensors.sweep_clock import SweepClock
from nvsf_core.sensors.tables import LaserTable

_MOMENTS = 256
"""Equal parts of a sweep at which the sensor's pose is interpolated."""
_AT_SENSOR_M = 0.01
"""Nearer than any surface."""
_NOWHERE_M = 60.0
"""Where a ray without an end is looked up."""


@dataclass(frozen=True, slots=True)
class Sweeps:
    """The n scans of a drive as the stage `sweeps` publishes them, and which are for training."""

    arrays: dict[str, np.ndarray]
    is_training: np.ndarray
    """(n,) bool."""
    trajectory: Trajectory
    """All recorded poses, held-out frames' too: views of these frames are requested by pose."""
    period_s: float
    """Seconds of one sweep; 0 where the scene is not ego-motion compensated."""
    table: LaserTable
    elevation_correction_rad: float
    """Angle by which rays were turned up."""

    def returns_of(self, scan: int) -> slice:
        """Slice of a scan's returns in the flat arrays."""
        return slice(int(self.arrays["offsets"][scan]), int(self.arrays["offsets"][scan + 1]))

    def fired_s(self, scan: int) -> np.ndarray:
        """(m,) float64 instants of a scan's returns, seconds since the first frame."""
        part = self.returns_of(scan)
        elapsed = self.arrays.get("elapsed", self.arrays["sweep_fraction"])[part]
        return float(self.arrays["time_s"][scan]) + elapsed.astype(np.float64) * self.period_s

    def clock_of(self, scan: int) -> SweepClock:
        """When in a scan's sweep each azimuth was measured."""
        return SweepClock.stored(self.arrays.get("sweep_clock"), scan)

    @property
    def training_clocks(self) -> tuple[SweepClock, ...]:
        """`clock_of` all training scans."""
        return tuple(self.clock_of(scan) for scan in np.flatnonzero(self.is_training).tolist())

    def clock_near(self, time_s: float) -> SweepClock:
        """The clock of the scan that is nearest to an instant, for sweeps of the recording sensor.

        Like its pose, a held-out scan's clock is part of what is asked for.
        """
        if "sweep_clock" not in self.arrays:
            return SweepClock()
        return self.clock_of(int(np.abs(self.arrays["time_s"] - time_s).argmin()))

    def is_of_world(self, chosen: slice = slice(None)) -> np.ndarray:
        """(m,) bool: whether chosen returns show the world, within the sensor's range.

        This is the only place that excludes the own vehicle, and what its bonnet mirrors.
        """
        a = self.arrays
        own = a["is_own_vehicle"][chosen] | a["is_mirrored"][chosen]
        return ~own & (a["range_m"][chosen] < self.table.max_range_m)

    def even_intensity(self, chosen: slice | np.ndarray) -> np.ndarray:
        """(m,) float32 intensity of chosen returns, divided by their lasers' gains."""
        laser = self.arrays["laser"][chosen]
        gain = np.where(laser >= 0, self.table.intensity_gain[laser], 1.0)
        return (self.arrays["intensity"][chosen] / gain).astype(np.float32)

    @property
    def bonnet(self) -> Bonnet | None:
        """The recording car's bonnet; None where it mirrored nothing."""
        shape = self.arrays.get("bonnet_shape")
        return None if shape is None else Bonnet(shape)

    @property
    def count(self) -> int:
        """Number of scans."""
        return len(self.arrays["frame"])


@dataclass(frozen=True, slots=True, eq=False)
class LinearPanos:
    """The scans as range images on the paper's linear grid, as the stage `pano` publishes them."""

    frame: np.ndarray
    """(n,) int64 ascending."""
    range_m: np.ndarray
    """(n, 66, 1030) float32 metres, 0 = no return."""
    intensity: np.ndarray
    """(n, 66, 1030) float32."""


def training_returns(sweeps: Sweeps) -> TimedReturns:
    """The training scans' returns, own vehicle included, for finding moving objects."""
    a, lengths = sweeps.arrays, np.diff(sweeps.arrays["offsets"])
    kept = np.repeat(sweeps.is_training, lengths)
    training = np.flatnonzero(sweeps.is_training).tolist()
    return TimedReturns(
        point_m=a["origin_m"][kept] + a["direction"][kept] * a["range_m"][kept, None],
        recorded_m=a["points_m"][kept],
        laser=a["laser"][kept],
        is_own_vehicle=a["is_own_vehicle"][kept] | a["is_mirrored"][kept],
        time_s=np.concatenate([np.zeros(0), *(sweeps.fired_s(scan) for scan in training)]),
        offsets=np.concatenate([[0], np.cumsum(lengths[sweeps.is_training])]),
        scan_time_s=a["time_s"][sweeps.is_training],
        clocks=sweeps.training_clocks,
        trajectory=sweeps.trajectory,
        period_s=sweeps.period_s,
        table=sweeps.table,
        elevation_correction_rad=sweeps.elevation_correction_rad,
    )


@dataclass(frozen=True, slots=True, eq=False)
class RecordedSweeps:
    """The n training scans in the grid of lasers and firings, and how their sensor moved."""

    prior: DropPrior
    lasers: np.ndarray
    """(l,) int64: lasers with any return, from the top."""
    range_m: np.ndarray
    """(n, lasers, f) float32 metres along the laser's ray, without its range bias; 0 = no return."""
    intensity: np.ndarray
    """(n, lasers, f) float32 as recorded."""
    trajectory: Trajectory
    table: LaserTable
    period_s: float
    turn_up_rad: float
    """Angle by which recorded directions are turned up on their way into the world."""

    unit_gaps: np.ndarray | None = None
    """(lasers, cells) bool, see `find_unit_gaps`; None where they are not known."""
    clocks: tuple[SweepClock, ...] = ()
    """(n,) when in each scan's sweep an azimuth was measured; empty = as by `SweepClock()`."""

    def hit_prior_at(self, points_m: np.ndarray, scans: np.ndarray) -> np.ndarray:
        """Share (r,) float32 of the scans that looked at points (r, 3) float32, scene-local, with a return.

        Only scans (k,) count that met a point's surface or nothing on the way there; what hid it, or a gap of
        the unit, tells nothing. A scan's share is that of its firing and those beside it, as 1 : 2 : 1. Where
        no scan tells it is 1: all that is known of the surface are its returns.
        """
        told, returned = np.zeros((2, len(points_m)), np.float32)
        for scan in scans.tolist():
            found = self.look(points_m, scan, gaps_hide=True)
            tells = found[:, SAME] + found[:, EMPTY]
            told += tells
            returned += tells * found[:, BESIDE]
        return np.where(told > 0, returned / np.maximum(told, 1.0), 1.0).astype(np.float32)

    def look(self, points_m: np.ndarray, scan: int, *, gaps_hide: bool) -> np.ndarray:
        """What one scan recorded towards points (r, 3) float32, scene-local: (r, 5) float32.

        Columns as of `look_up_scans`. If gaps hide, the unit's gaps are as if something at the sensor hid
        what is behind it; else they have no return, as recorded.
        """
        found = np.zeros((len(points_m), 5), np.float32)
        range_m = self.range_m[scan]
        if gaps_hide:
            range_m = np.where(self.gaps_of(scan), np.float32(_AT_SENSOR_M), range_m)
        look_up_scans(points_m, self._lasers, self._sweep(scan, range_m), found)
        return found

    def position_m(self, scan: int) -> np.ndarray:
        """(3,) scene-local position of the sensor at the instant of a scan."""
        return np.asarray(self.trajectory.at(self.prior.time_s[scan : scan + 1])[1][0])

    def gaps_of(self, scan: int) -> np.ndarray:
        """(lasers, f) bool: which of a scan's firings lie in gaps of the unit."""
        shape = self.range_m.shape[1:]
        if self.unit_gaps is None:
            return np.zeros(shape, bool)
        fraction = self.prior.fraction[scan]
        cells = cells_of(np.where(np.isfinite(fraction), fraction, 0.0), self.unit_gaps.shape[1])
        return np.asarray(self.unit_gaps[:, cells])

    @property
    def _lasers(self) -> Lasers:
        table, rows = self.table, self.lasers
        elevation_rad, up_m = table.elevation_rad[rows], table.vertical_offset_m[rows]
        shift_rad = (table.phase_steps - table.firing_shift_steps)[rows] * table.step_rad
        return Lasers(
            rows, elevation_rad, up_m, up_m / np.cos(elevation_rad), table.horizontal_offset_m[rows],
            shift_rad, self.turn_up_rad,
        )  # fmt: skip

    def _sweep(self, scan: int, range_m: np.ndarray) -> SweepGrid:
        moments = (np.arange(_MOMENTS) + 0.5) / _MOMENTS - 0.5
        elapsed = self.clocks[scan].elapsed(moments) if self.clocks else moments
        rotation, position = self.trajectory.at(self.prior.time_s[scan] + elapsed * self.period_s)
        fraction = self.prior.fraction[scan][: self.prior.firings_of(scan)]
        return SweepGrid(rotation, position, fraction, range_m, self.intensity[scan])


def ray_ends_m(rays: SweepRays, range_m: np.ndarray) -> np.ndarray:
    """(r, 3) float32, scene-local: where rays of ranges (r,) end; one without an end is looked up at 60 m."""
    reach_m = np.where(np.isfinite(range_m), range_m, _NOWHERE_M)
    return (rays.origin_m + rays.direction * reach_m[:, None]).astype(np.float32)


class ScanLookups:
    """What k training scans recorded where the rays of a sweep end, for all who ask on the sweep's way."""

    def __init__(self, scan_grids: RecordedSweeps, scans: np.ndarray, *, gaps_hide: bool = False) -> None:
        """Take the scans (k,) that are asked, nearest in time first; `gaps_hide` as of `look`."""
        self.scan_grids, self.scans, self._gaps_hide = scan_grids, scans, gaps_hide
        self._ends_m, self._found = np.zeros((0, 3), np.float32), np.zeros((len(scans), 0, 5), np.float32)

    def at(self, ends_m: np.ndarray) -> np.ndarray:
        """(k, r, 5) float32 of the rays' ends (r, 3), columns as of `look_up_scans`; valid until asked again.

        Of r rays that were asked before, those whose ends have changed since are looked up again.
        """
        changed: slice | np.ndarray = slice(None)
        if len(ends_m) == len(self._ends_m):
            changed = np.flatnonzero((ends_m != self._ends_m).any(axis=1))
        else:
            self._found = np.empty((len(self.scans), len(ends_m), 5), np.float32)
        for found, scan in zip(self._found, self.scans.tolist(), strict=True):
            found[changed] = self.scan_grids.look(ends_m[changed], scan, gaps_hide=self._gaps_hide)
        self._ends_m = ends_m
        return self._found


def recorded_sweeps(sweeps: Sweeps, evidence: SceneEvidence) -> RecordedSweeps:
    """All training scans in the grid of lasers and firings of the drop prior."""
    a, prior = sweeps.arrays, evidence.prior
    ranges, shine = (np.zeros(prior.is_hit.shape, np.float32) for _ in range(2))
    for number, scan in enumerate(np.flatnonzero(sweeps.is_training).tolist()):
        part = sweeps.returns_of(scan)
        laser, offsets = a["laser"][part], np.array([0, part.stop - part.start])
        _, cells = find_cells(
            laser, a["firing"][part], a["sweep_fraction"][part], offsets, a["firings"][scan : scan + 1],
            nominal_firings=sweeps.table.firings_per_turn,
        )  # fmt: skip
        known = cells.is_known
        cell = (number, laser[known], cells.column[known])
        ranges[cell], shine[cell] = a["range_m"][part][known], a["intensity"][part][known]
    return RecordedSweeps(
        prior, evidence.lasers.astype(np.int64), ranges, shine, sweeps.trajectory, sweeps.table,
        sweeps.period_s, sweeps.elevation_correction_rad, evidence.unit_gaps,
        sweeps.training_clocks,
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class LidarRecording:
    """The scans, and the evidence of the training scans."""

    sweeps: Sweeps
    evidence: SceneEvidence
    read_panos: Callable[[], LinearPanos] | None = None
    """Reads the scans as the paper's panos; None where they were not projected."""

    @property
    def far_m(self) -> float:
        """Greatest range of a simulated ray, metres."""
        return float(self.sweeps.table.max_range_m)

    @cached_property
    def firing_phase(self) -> float:
        """The `phase` of a sweep of the recording sensor: its scans', one half where they have none."""
        return self.evidence.prior.firing_phase()

    @cached_property
    def scan_grids(self) -> RecordedSweeps:
        """The training scans by laser and firing, for looking points up in them."""
        return recorded_sweeps(self.sweeps, self.evidence)

    @property
    def object_hit_priors(self) -> ObjectHitPriors:
        """For looking up in which share of the scans a point on a moving object returned."""
        sweeps, evidence = self.sweeps, self.evidence
        return ObjectHitPriors(
            evidence.prior, evidence.lasers, sweeps.trajectory, sweeps.table, sweeps.elevation_correction_rad
        )

    def moving(self, *, leave_out: int | None = None) -> NearObjects | None:
        """Moving objects at any time, built without the training scan `leave_out`; None without any."""
        return self._by_all_scans if leave_out is None else self._near_objects(leave_out)

    @cached_property
    def _by_all_scans(self) -> NearObjects | None:
        return self._near_objects(None)

    def _near_objects(self, leave_out: int | None) -> NearObjects | None:
        objects = self.evidence.objects
        return NearObjects(objects, self.object_hit_priors, leave_out=leave_out) if objects else None


@dataclass(frozen=True, slots=True, kw_only=True)
class Recording:
    """A drive with LiDAR, cameras, or both; all scene-local."""

    lidar: LidarRecording | None
    cameras: dict[str, CameraRecording]
    trajectory: Trajectory
    """Of the LiDAR's frame; without LiDAR, of the frame that calibration or poses give instead."""
    posed_frame: np.ndarray
    """(p,) int64 ascending: frames with a pose, whichever sensor recorded them."""
    posed_time_s: np.ndarray
    """(p,) float64: their instants."""
