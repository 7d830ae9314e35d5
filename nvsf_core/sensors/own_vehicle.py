"""The recording car in its own scans: it stands still in the sensor's frame.

Some 140 returns a scan lie nearer than 2.5 m, on the car itself. No scene holds them, so they are learned
once a drive and put back into what is simulated.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nvsf_core.sensors.tables import LaserTable

NEAR_M = 2.5
"""Only returns nearer than this can be the own vehicle's."""
_MIN_SHARE = 0.5
"""Share of the scans in which a cell must have a near return."""


@dataclass(frozen=True, slots=True, eq=False)
class OwnVehicle:
    """Cells of laser x azimuth on which the recording car lies, in the sensor's frame."""

    range_m: np.ndarray
    """(L, cells) float32 median distance from the sensor's centre, 0 = not the own vehicle."""
    intensity: np.ndarray
    """(L, cells) float32 median intensity."""

    def is_own(self, table: LaserTable, points_m: np.ndarray, laser: np.ndarray) -> np.ndarray:
        """Whether each return (N,) is the own vehicle's: nearer than 2.5 m, in or beside one of its cells.

        Beside (one laser, two azimuth cells), because at the car's edges firings hit in fewer than half
        of the scans: on KITTI-360 the cells themselves hold 85 of 140 such returns a scan.
        """
        row, column = _cells(table, points_m, laser, self.range_m.shape[1])
        near: np.ndarray = _distance(points_m) < NEAR_M
        return near & _beside(self.range_m > 0.0)[row, column]


def learn_own_vehicle(
    table: LaserTable, scans: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]], azimuth_cells: int = 2000
) -> OwnVehicle:
    """Learn the own vehicle from training scans: where at least half of them have a return below 2.5 m.

    Args:
        table: The sensor.
        scans: For each training scan points (N, 3), intensity (N,), laser (N,), as recorded.
        azimuth_cells: Cells of a turn; at most the turn's firings, or cells stay empty by chance.
    """
    size = table.laser_count * azimuth_cells
    cells, ranges, intensities = [np.zeros(0, np.int64)], [np.zeros(0)], [np.zeros(0)]
    seen = np.zeros(size, np.int64)
    for points_m, intensity, laser in scans:
        distance_m = _distance(points_m)
        near = distance_m < NEAR_M
        row, column = _cells(table, points_m[near], laser[near], azimuth_cells)
        cell = row * azimuth_cells + column
        seen[np.unique(cell)] += 1
        cells.append(cell)
        ranges.append(distance_m[near])
        intensities.append(intensity[near])
    own = seen >= max(1.0, _MIN_SHARE * len(scans))
    all_cells = np.concatenate(cells)
    shape = (table.laser_count, azimuth_cells)
    return OwnVehicle(
        range_m=_medians(all_cells, np.concatenate(ranges), own).reshape(shape),
        intensity=_medians(all_cells, np.concatenate(intensities), own).reshape(shape),
    )


def _beside(own: np.ndarray) -> np.ndarray:
    """Cells within one laser and two azimuth cells of an own one; azimuth wraps, lasers do not."""
    wide = np.logical_or.reduce([np.roll(own, shift, axis=1) for shift in range(-2, 3)])
    grown = wide.copy()
    grown[1:] |= wide[:-1]
    grown[:-1] |= wide[1:]
    return grown


def _medians(cell: np.ndarray, value: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Median value of each wanted cell, 0 elsewhere."""
    medians = np.zeros(len(wanted), np.float32)
    order = np.argsort(cell, kind="stable")
    names, starts = np.unique(cell[order], return_index=True)
    for name, values in zip(names, np.split(value[order], starts[1:]), strict=False):
        if wanted[name]:
            medians[name] = np.median(values)
    return medians


def _cells(
    table: LaserTable, points_m: np.ndarray, laser: np.ndarray, azimuth_cells: int
) -> tuple[np.ndarray, np.ndarray]:
    azimuth = np.mod(np.arctan2(points_m[:, 1], points_m[:, 0]).astype(np.float64), 2.0 * np.pi)
    column = np.floor(azimuth / (2.0 * np.pi) * azimuth_cells).astype(np.int64) % azimuth_cells
    row = laser.astype(np.int64)
    unknown = row < 0
    if unknown.any():
        # Without a laser, the nearest elevation of the table is as good a row as any: it is fixed too.
        range_m = np.maximum(_distance(points_m[unknown]), 1e-6)
        elevation = np.arcsin(np.clip(points_m[unknown, 2] / range_m, -1.0, 1.0))
        descending = table.elevation_rad
        middle = 0.5 * (descending[:-1] + descending[1:])
        row[unknown] = np.searchsorted(-middle, -elevation)
    return row, column


def _distance(points_m: np.ndarray) -> np.ndarray:
    distance: np.ndarray = np.linalg.norm(points_m.astype(np.float64), axis=1)
    return distance
