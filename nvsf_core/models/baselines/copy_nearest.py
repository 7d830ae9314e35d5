"""The baseline `copy_nearest`: the training scan or image nearest in time, unchanged."""

import numpy as np

_CLOCK_JITTER_S = 0.005
"""Two recordings whose time differences differ by less count as equally near: clocks jitter."""
_SAME_RAY_RAD = np.deg2rad(0.18)
"""Largest azimuth between a ray and the return copied to it, one of 2000 steps of a rotation; of a scan with
wider steps half a step, since whatever ray is asked then has a firing that near."""


def nearest_earlier(time_s: np.ndarray, wanted_s: float) -> int:
    """Index of the recording, of times (n,) s, nearest to `wanted_s`; the earlier of two equally near."""
    apart = np.abs(time_s - wanted_s)
    return int(np.flatnonzero(apart <= apart.min() + _CLOCK_JITTER_S)[0])


def copied_ranges(
    copied_points_m: np.ndarray,
    copied_laser: np.ndarray,
    copied_range_m: np.ndarray,
    copied_intensity: np.ndarray,
    points_m: np.ndarray,
    laser: np.ndarray,
    *,
    firings: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Range (r,) float32 in metres and intensity (r,) float32 of r rays, copied from another scan.

    A ray gets the return of the same laser that is nearest in azimuth, within 0.18 degrees or half a step
    from firing to firing; without one its range is infinite and its intensity 0.

    Args:
        copied_points_m: (n, 3) returns of the copied scan, in the sensor's frame.
        copied_laser: (n,) laser of each.
        copied_range_m: (n,).
        copied_intensity: (n,).
        points_m: (r, 3) points on the rays, in the sensor's frame; only their azimuth is used.
        laser: (r,) laser of each ray; -1 = unknown.
        firings: Firings of the copied scan.
    """
    near_rad = max(_SAME_RAY_RAD, np.pi / firings)
    range_m = np.full(len(points_m), np.inf, np.float32)
    intensity = np.zeros(len(points_m), np.float32)
    copied_azimuth = np.arctan2(copied_points_m[:, 1], copied_points_m[:, 0])
    azimuth = np.arctan2(points_m[:, 1], points_m[:, 0])
    for row in np.unique(laser[laser >= 0]):
        source = np.flatnonzero(copied_laser == row)
        if len(source) == 0:
            continue
        source = source[np.argsort(copied_azimuth[source])]
        angles = copied_azimuth[source]
        around = np.concatenate([[angles[-1] - 2 * np.pi], angles, [angles[0] + 2 * np.pi]])
        wanted = np.flatnonzero(laser == row)
        right = np.clip(np.searchsorted(around, azimuth[wanted]), 1, len(around) - 1)
        left_is_nearer = azimuth[wanted] - around[right - 1] < around[right] - azimuth[wanted]
        chosen = right - left_is_nearer
        near = np.abs(around[chosen] - azimuth[wanted]) <= near_rad
        found = source[(chosen - 1) % len(source)]
        range_m[wanted[near]] = copied_range_m[found[near]]
        intensity[wanted[near]] = copied_intensity[found[near]]
    return range_m, intensity
