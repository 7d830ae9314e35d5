"""The own vehicle's returns, which are at the same place in the sensor's frame in every scan.

Some 140 returns a scan, nearer than 2.5 m, lie on the recording car itself. They are not part of the scene:
they are learned once per drive and added to simulated scans.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nvsf_core.sensors.tables import LaserTable

NEAR_M = 2.5
"""Only returns nearer than this can be the own vehicle's."""
_MIN_SHARE = 0.5
"""Least share of the scans in which a cell must have a near return."""


@dataclass(frozen=True, slots=True, eq=False)
class OwnVehicle:
    """Ranges of the own vehicle in a grid of L lasers and azimuth cells, in the sensor's frame."""

    range_m: np.ndarray
    """(L, cells) float32 metres: median distance from the sensor's centre, 0 = not the own vehicle."""
    intensity: np.ndarray
    """(L, cells) float32: median intensity, 0..1."""

    def is_own(self, table: LaserTable, points_m: np.ndarray, laser: np.ndarray) -> np.ndarray:
        """Whether (N,) bool returns are on the own vehicle: nearer than 2.5 m, in or beside one of its cells.

        Cells beside (one laser, two azimuth cells) count because at the car's edges rays hit it in fewer than
        half of the scans: on KITTI-360 its own cells hold 85 of 140 such returns. Points (N, 3) are in metres
        as recorded; laser (N,) int is -1 where unknown.
        """
        row, column = _cells(table, points_m, laser, self.range_m.shape[1])
        near: np.ndarray = _distance(points_m) < NEAR_M
        return near & _beside(self.range_m > 0.0)[row, column]


def learn_own_vehicle(
    table: LaserTable, scans: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]], azimuth_cells: int = 2000
) -> OwnVehicle:
    """Learn the own vehicle from training scans: cells in which at least half have a return below 2.5 m.

    Args:
        table: The sensor.
        scans: For each training scan points (N, 3) in metres as recorded, intensity (N,), laser (N,).
        azimuth_cells: Cells around the sensor; at most the firings of a sweep, or some stay empty by chance.
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
        # Without a laser, the row of the nearest elevation: on the car it is the same in each scan, too.
        range_m = np.maximum(_distance(points_m[unknown]), 1e-6)
        elevation = np.arcsin(np.clip(points_m[unknown, 2] / range_m, -1.0, 1.0))
        descending = table.elevation_rad
        middle = 0.5 * (descending[:-1] + descending[1:])
        row[unknown] = np.searchsorted(-middle, -elevation)
    return row, column


def _distance(points_m: np.ndarray) -> np.ndarray:
    distance: np.ndarray = np.linalg.norm(points_m.astype(np.float64), axis=1)
    return distance
