"""How two scans differ in their distributions: returns by laser, by range and by incidence, and intensity.

Scans are compared on the grid of lasers and firings. Every measure is 0 for scans that are distributed alike,
wherever their returns lie.
"""

from dataclasses import dataclass

import numpy as np

from nvsf_core.errors import ShapeError

COLUMNS = 1000
"""Firings of a scan that are compared: one sweep may have a few more than another."""
_RANGES_M = np.array([0.0, 2.0, 4.0, 6.0, 8.0, 10.0, 13.0, 16.0, 20.0, 25.0, 32.0, 40.0, 50.0, 65.0, 80.0])
_INCIDENCE_RAD = np.deg2rad(np.arange(0.0, 91.0, 10.0))
_BESIDE = 4
"""Columns between the returns that a surface's direction is taken from: their distance exceeds the noise."""
_LEAST_RETURNS = 20
"""Of a cell of range and incidence, for a mean intensity."""


@dataclass(frozen=True, slots=True, eq=False)
class ScanGrid:
    """The returns of a scan on its lasers and `COLUMNS` firings; none of the own vehicle."""

    points_m: np.ndarray
    """(L, COLUMNS, 3) float64, sensor's frame; zeros where nothing returned."""
    intensity: np.ndarray
    """(L, COLUMNS) 0..1."""

    @property
    def range_m(self) -> np.ndarray:
        """(L, COLUMNS) distance from the sensor, metres; 0 = no return."""
        return np.asarray(np.linalg.norm(self.points_m, axis=-1))


def scan_grid(points_m: np.ndarray, intensity: np.ndarray) -> ScanGrid:
    """The grid of a scan, with `COLUMNS` of its firings.

    Args:
        points_m: (L, F, 3), zeros where nothing returned.
        intensity: (L, F).

    Raises:
        ShapeError: The shapes do not belong together.
    """
    if points_m.shape != (*intensity.shape, 3) or intensity.ndim != 2 or intensity.shape[1] == 0:
        raise ShapeError(f"expected points (L, F, 3) and intensity (L, F), found {points_m.shape}, "
                         f"{intensity.shape}")  # fmt: skip
    column = (np.arange(COLUMNS) + 0.5) * intensity.shape[1] / COLUMNS
    return ScanGrid(*(np.asarray(one[:, column.astype(np.int64)]) for one in (points_m, intensity)))


def hits_differ(one: ScanGrid, other: ScanGrid) -> float:
    """Share of the rays that return in only one of two scans of the same lasers."""
    return float(np.mean((one.range_m > 0.0) != (other.range_m > 0.0)))


def hit_rate_by_laser(scan: ScanGrid) -> np.ndarray:
    """(L,) share of each laser's rays that return."""
    return np.asarray((scan.range_m > 0.0).mean(axis=1))


def returns_by_range(scan: ScanGrid) -> np.ndarray:
    """Cumulative shares of the returns by range, up to 80 m; NaN for a scan without returns."""
    return _cumulative(scan.range_m[scan.range_m > 0.0], _RANGES_M)


def returns_by_incidence(scan: ScanGrid) -> np.ndarray:
    """Cumulative shares of the returns by incidence, 0 to 90 degrees; NaN without any."""
    found = incidence_rad(scan)
    return _cumulative(found[np.isfinite(found)], _INCIDENCE_RAD)


def range_distance_m(one: np.ndarray, other: np.ndarray) -> float:
    """Earth mover's distance of two `returns_by_range`, metres."""
    return float(np.sum(np.abs(one - other) * np.diff(_RANGES_M)))


def incidence_distance_deg(one: np.ndarray, other: np.ndarray) -> float:
    """Earth mover's distance of two `returns_by_incidence`, degrees."""
    return float(np.sum(np.abs(one - other) * np.rad2deg(np.diff(_INCIDENCE_RAD))))


def intensity_table(scan: ScanGrid) -> np.ndarray:
    """(R, I) mean intensity by range and incidence; NaN for a cell of few returns."""
    angle = incidence_rad(scan)
    used = np.isfinite(angle)
    row = np.clip(np.digitize(scan.range_m[used], _RANGES_M) - 1, 0, len(_RANGES_M) - 2)
    column = np.clip(np.digitize(angle[used], _INCIDENCE_RAD) - 1, 0, len(_INCIDENCE_RAD) - 2)
    shape = (len(_RANGES_M) - 1, len(_INCIDENCE_RAD) - 1)
    cell = row * shape[1] + column
    count = np.bincount(cell, minlength=shape[0] * shape[1])
    total = np.bincount(cell, scan.intensity[used], minlength=shape[0] * shape[1])
    enough = count >= _LEAST_RETURNS
    return np.where(enough, total / np.maximum(count, 1), np.nan).reshape(shape)


def table_distance(one: np.ndarray, other: np.ndarray) -> float:
    """Mean absolute difference of two tables over the cells that both have; NaN without one."""
    both = np.isfinite(one) & np.isfinite(other)
    return float(np.abs(one - other)[both].mean()) if both.any() else float("nan")


def incidence_rad(scan: ScanGrid) -> np.ndarray:
    """(L, COLUMNS) angle between each ray and its surface's normal; NaN where a neighbour is missing.

    The normal is that of the plane through the returns of the lasers above and below and of firings before
    and after.
    """
    points, there = scan.points_m, scan.range_m > 0.0
    found = np.full(there.shape, np.nan)
    if there.shape[0] < 3:
        return found
    middle = (slice(1, -1), slice(_BESIDE, -_BESIDE))
    across = points[1:-1, 2 * _BESIDE :] - points[1:-1, : -2 * _BESIDE]
    down = points[2:, _BESIDE:-_BESIDE] - points[:-2, _BESIDE:-_BESIDE]
    complete = there[middle] & there[1:-1, 2 * _BESIDE :] & there[1:-1, : -2 * _BESIDE]
    complete &= there[2:, _BESIDE:-_BESIDE] & there[:-2, _BESIDE:-_BESIDE]
    normal = np.cross(across, down)
    length = np.linalg.norm(normal, axis=-1) * scan.range_m[middle]
    complete &= length > 0.0
    cosine = np.abs((normal * points[middle]).sum(axis=-1)) / np.where(complete, length, 1.0)
    found[middle] = np.where(complete, np.arccos(np.clip(cosine, 0.0, 1.0)), np.nan)
    return found


def _cumulative(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    count, _ = np.histogram(np.minimum(values, edges[-1]), edges)
    return np.cumsum(count) / count.sum() if count.sum() else np.full(len(edges) - 1, np.nan)
