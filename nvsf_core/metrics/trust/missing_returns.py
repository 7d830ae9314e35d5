"""Which returns a scan lacks: rays along which recorded scans returned, seen from its place, and it did not.

The other cues of scans ask the returns that are there; a model that drops rays with certainty would please
them all. A recorded return proves a surface, wherever it is seen from: a ray towards it meets that surface or
something nearer, so that it returns. No laser need be shared, so that scans of any sensor can be asked.
"""

from collections.abc import Sequence

import numpy as np

from nvsf_core.errors import ShapeError

_NEAR_M = 3.0
"""Nearer is the own vehicle."""
_FAR_M, _SURELY = 50.0, 0.9
"""From farther away, or near the end of the sensor's range, a surface that returned to one place may not to
another."""
_BESIDE_RAD = np.deg2rad(0.3)
"""A recorded return farther than this above or below all lasers proves nothing about their rays."""
_LEAST_PROVEN = 100
"""Of fewer rays a share tells nothing."""


def missing_share(
    azimuth_rad: np.ndarray,
    laser_rad: np.ndarray,
    returned: np.ndarray,
    recorded_m: Sequence[np.ndarray],
    *,
    max_range_m: float,
) -> float:
    """Share of the rays that all recorded scans prove to return which do not; NaN if too few are proven.

    Rays are compared in cells of direction, a laser by a firing: a cell is proven if each recorded scan has a
    return in it. Two scans say it more surely than one, some of whose returns came by chance.

    Args:
        azimuth_rad: (L, F) of the rays of each laser and firing, in the sensor's frame.
        laser_rad: (L,) elevations of the lasers there.
        returned: (L, F) bool.
        recorded_m: Returns (n, 3) of each recorded scan, in the frame of the scan in question.
        max_range_m: Of the sensor: it does not answer from beyond.

    Raises:
        ShapeError: The shapes do not belong together.
    """
    if returned.ndim != 2 or azimuth_rad.shape != returned.shape or laser_rad.shape != returned.shape[:1]:
        raise ShapeError(f"expected azimuths and returns (L, F) and elevations (L,), found "
                         f"{azimuth_rad.shape}, {returned.shape}, {laser_rad.shape}")  # fmt: skip
    if not recorded_m:
        return float("nan")
    column = _column(azimuth_rad, returned.shape[1])
    row = np.broadcast_to(np.arange(len(returned))[:, None], column.shape)
    proven, answered = np.zeros((2, *returned.shape), bool)
    proven[row, column] = True
    answered[row[returned], column[returned]] = True
    for points_m in recorded_m:
        proven &= _cells_of(points_m, laser_rad, returned.shape[1], min(_FAR_M, _SURELY * max_range_m))
    count = int(proven.sum())
    return float((proven & ~answered).sum() / count) if count >= _LEAST_PROVEN else float("nan")


def _cells_of(points_m: np.ndarray, laser_rad: np.ndarray, firings: int, far_m: float) -> np.ndarray:
    """(L, F) bool: cells with a return (n, 3), by the nearest of the lasers' elevations (L,)."""
    range_m = np.linalg.norm(points_m, axis=1)
    kept = (range_m > _NEAR_M) & (range_m < far_m)
    x, y, z = points_m[kept].T
    elevation_rad = np.arcsin(z / range_m[kept])
    order = np.argsort(laser_rad)
    between = 0.5 * (laser_rad[order][1:] + laser_rad[order][:-1])
    laser = order[np.searchsorted(between, elevation_rad)]
    near = np.abs(laser_rad[laser] - elevation_rad) < _BESIDE_RAD
    found = np.zeros((len(laser_rad), firings), bool)
    found[laser[near], _column(np.arctan2(y, x)[near], firings)] = True
    return found


def _column(azimuth_rad: np.ndarray, firings: int) -> np.ndarray:
    """Cell of azimuths, 0..firings - 1."""
    turned = np.floor(azimuth_rad / (2.0 * np.pi) * firings).astype(np.int64)
    return np.asarray(turned % firings)
