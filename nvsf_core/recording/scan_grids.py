"""The training scans on the sensor's grid of lasers and firings, and what they recorded at given points."""

from dataclasses import dataclass

import numpy as np

from nvsf_core.evidence.drop_prior import DropPrior, cells_of, find_cells
from nvsf_core.evidence.scene_evidence import SceneEvidence
from nvsf_core.kernels.scan_lookup import BESIDE, EMPTY, SAME, Lasers, SweepGrid, look_up_scans
from nvsf_core.recording.sweeps import Sweeps
from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.sensors.tables import LaserTable

NEAREST = 2
"""Of the scans that are looked up, those nearest in time, which are counted by themselves too."""
_MOMENTS = 256
"""Equal parts of a sweep at which the sensor's pose is interpolated."""
_AT_SENSOR_M = 0.01
"""Nearer than any surface."""


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

    def ask(self, points_m: np.ndarray, scans: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Look up points (r, 3) float32, scene-local, in scans (k,), nearest in time first.

        Returns the counts (r, 5) float32 of `look_up_scans`, summed over the first two scans and over all.
        """
        found = np.zeros((len(points_m), 5), np.float32)
        nearest = found
        for number, scan in enumerate(scans.tolist()):
            if number == NEAREST:
                nearest = found.copy()
            look_up_scans(points_m, self._lasers, self._sweep(scan, self.range_m[scan]), found)
        return nearest, found

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
        shift_rad = (table.phase_steps - table.firing_shift_steps)[rows] * table.step_rad
        return Lasers(
            rows, table.elevation_rad[rows], table.vertical_offset_m[rows], table.horizontal_offset_m[rows],
            shift_rad, self.turn_up_rad,
        )  # fmt: skip

    def _sweep(self, scan: int, range_m: np.ndarray) -> SweepGrid:
        moments = (np.arange(_MOMENTS) + 0.5) / _MOMENTS - 0.5
        rotation, position = self.trajectory.at(self.prior.time_s[scan] + moments * self.period_s)
        fraction = self.prior.fraction[scan][: self.prior.firings_of(scan)]
        return SweepGrid(rotation, position, fraction, range_m, self.intensity[scan])


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
    )  # fmt: skip
