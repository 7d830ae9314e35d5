"""Whether the points of a scan were seen from its origin, as one sensor's are, by the cones of its lasers.

A laser that rotates about the upright axis through (x, y, z) sees points on a cone with that apex. At azimuth
a and horizontal distance rho from the scan's origin they have, where rho is much larger than hypot(x, y),
    height = z + slope (rho - x cos a - y sin a),
which is linear in z, slope, slope x and slope y. It is fitted again about the place that was found.
"""

from collections.abc import Sequence

import numpy as np

_NEAREST_M = 5.0
"""Nearer points are not much farther than another sensor of the car."""
_FEWEST_RETURNS = 100
_LEAST_SLOPE = 0.05
"""Of a laser that looks up or down enough to show where it looks from."""
_LARGEST_OFF_RAD = np.deg2rad(0.15)
"""Largest robust spread of a laser's returns about its cone."""
_LEAST_OFF_RAD = 1e-4
"""Returns this near to a cone are never outliers."""
_STEPS = 5
"""Of the fit: about the last one's axis."""
_LEAST_APART_M = 0.15
"""Lasers of one sensor lie nearer together, and nearer to its origin."""
_SINGULAR = 1e-3
"""Least share of the smallest singular value: on flat ground a circle says no slope."""


def origin_words(groups: Sequence[np.ndarray]) -> str:
    """What is to be said of where a scan's lasers look from; empty if nothing speaks against the origin.

    Of each laser `groups` has (n, 4) points, metres, and the scan that each is of, in file order.
    """
    apexes = [_apex(part) for rows in groups for part in _rounds(rows)]
    found_m = np.array([one for one in apexes if one is not None]).reshape(-1, 3)
    if len(found_m) < 4:
        return ""
    middle_m = np.median(found_m, axis=0)
    _, _, axes = np.linalg.svd(found_m - middle_m, full_matrices=False)
    low_m, high_m = np.percentile((found_m - middle_m) @ axes[0], [20.0, 80.0])
    if high_m - low_m > _LEAST_APART_M:
        return (
            f"its rays do not meet in one point, they come from places {high_m - low_m:.1f} m apart: this "
            "looks like a cloud of more than one sensor; give each sensor's scans by themselves, in its own "
            "frame and with its own mounting (`lidar_to_pose` of drive.json, or transforms to its frame)"
        )
    # Upwards lasers may have lever arms.
    if np.linalg.norm(middle_m[:2]) > _LEAST_APART_M:
        return (
            f"its rays meet in {middle_m.round(1).tolist()} m and not in the origin: give the points of "
            "one sensor in its own frame, and its mounting (`lidar_to_pose` of drive.json, or transforms)"
        )
    return ""


def _rounds(rows: np.ndarray) -> list[np.ndarray]:
    """A laser's points of one scan, each time around the sensor by itself: two may number lasers alike."""
    own = rows[rows[:, 3] == rows[0, 3]]
    azimuth = np.unwrap(np.arctan2(own[:, 1], own[:, 0]))
    around = np.floor(np.abs(azimuth - azimuth[0]) / (2.0 * np.pi))
    return [own[around == one] for one in np.unique(around)]


def _apex(rows: np.ndarray) -> np.ndarray | None:
    """(3,) place that a laser looks from, metres; None if its points do not say."""
    rows = rows[np.hypot(rows[:, 0], rows[:, 1]) > _NEAREST_M]
    if len(rows) < _FEWEST_RETURNS:
        return None
    apex_m, kept = np.zeros(3), np.ones(len(rows), np.bool_)
    for _ in range(_STEPS):
        flat_m = rows[:, :2] - apex_m[:2]
        rho_m = np.linalg.norm(flat_m, axis=1)
        # Each row by 1 / rho: what is left is an angle.
        terms = np.column_stack([1.0 / rho_m, np.ones(len(rho_m)), -flat_m / rho_m[:, None] ** 2])
        height = rows[:, 2] / rho_m
        scale = np.linalg.norm(terms[kept], axis=0)
        found, _, _, singular = np.linalg.lstsq(terms[kept] / scale, height[kept])
        off = np.abs(terms @ (found / scale) - height)
        spread = 1.4826 * float(np.median(off))
        kept = off <= max(3.0 * spread, _LEAST_OFF_RAD)
        z_m, slope, *slope_flat = found / scale
        if abs(slope) < _LEAST_SLOPE or singular[-1] <= _SINGULAR * singular[0]:
            return None
        apex_m = np.array([*(apex_m[:2] + np.array(slope_flat) / slope), z_m])
        if not np.linalg.norm(apex_m) < _NEAREST_M:
            return None
    return apex_m if spread <= _LARGEST_OFF_RAD else None
