"""Share of recorded scans that returned in the direction of given places, interpolated between their rays."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit, prange

from nvsf_core.kernels.voxel_march import RAYS_A_TASK

_TURN_RAD = 2.0 * np.pi


class FiringLasers(NamedTuple):
    """Where the lasers of a sensor look."""

    turned_down_rad: float
    """Angle by which a ray in the world lies above the same ray as recorded."""
    number: np.ndarray
    """(l,) int64 lasers that ever return, at least one."""
    elevation_rad: np.ndarray
    """(L,) of all lasers."""
    vertical_offset_m: np.ndarray
    """(L,) lever arm across the ray, upwards."""
    horizontal_offset_m: np.ndarray
    """(L,) lever arm across the ray, to the left."""
    shift_rad: np.ndarray
    """(L,) by which a laser looks ahead of the encoder."""


@njit(inline="always")
def _of_laser(azimuth_rad, flat_m, horizontal_offset_m, shift_rad, fraction, last, row):  # type: ignore[no-untyped-def]
    """Share of one laser's two firings beside a place that returned, the nearer one counting more."""
    turned = azimuth_rad - math.asin(min(max(horizontal_offset_m / flat_m, -1.0), 1.0)) - shift_rad
    wanted = -(turned / _TURN_RAD - math.floor(turned / _TURN_RAD + 0.5))
    right = min(max(np.searchsorted(fraction, wanted), 1), last)
    left = right - 1
    before = float(fraction[left])
    gap = float(fraction[right]) - before
    share = (wanted - before) / gap if gap > 0.0 else 0.0
    share = min(max(share, 0.0), 1.0)
    return (1.0 - share) * row[left] + share * row[right]


@njit(inline="always")
def _of_scan(  # type: ignore[no-untyped-def]
    x, y, z, lasers, fraction, last, is_hit
):
    """Share of one scan's firings that returned, at a place (x, y, z) of its sensor's frame."""
    turned_down_rad, numbers, looks_rad, vertical_offset_m, horizontal_offset_m, shift_rad = lasers
    azimuth_rad, ahead_m, range_m = math.atan2(y, x), math.hypot(x, y), math.sqrt(x * x + y * y + z * z)
    cosine, sine = math.cos(turned_down_rad), math.sin(turned_down_rad)
    flat_m = abs(cosine * ahead_m + sine * z)
    elevation_rad = math.atan2(cosine * z - sine * ahead_m, flat_m)
    above, below = -1, -1
    above_rad, below_rad = np.inf, np.inf
    for laser in numbers:
        apart = looks_rad[laser] + vertical_offset_m[laser] / range_m - elevation_rad
        if 0.0 < apart < above_rad:
            above, above_rad = laser, apart
        elif apart <= 0.0 and -apart < below_rad:
            below, below_rad = laser, -apart
    total, weight = 0.0, 0.0
    for laser, other_rad in ((above, below_rad), (below, above_rad)):
        if laser < 0:
            continue
        # Beyond the outermost laser there is no other to share with.
        own = other_rad / (above_rad + below_rad) if above >= 0 and below >= 0 else 1.0
        total += own * _of_laser(
            azimuth_rad, flat_m, horizontal_offset_m[laser], shift_rad[laser], fraction, last, is_hit[laser]
        )
        weight += own
    return total / weight


@njit(parallel=True, cache=True, nogil=True)
def share_of_scans(  # type: ignore[no-untyped-def]
    places_m, to_sensor, weights, lasers, scans, fraction, is_hit
):
    """Share (v,) float32 of some scans, by weight, that returned towards places of a frame of their own.

    The two lasers and two firings of each that look beside a place are weighted by how near to it they do.

    Args:
        places_m: (v, 3) float64, none of them a sensor's centre.
        to_sensor: (k, 4, 4) float64 from the places' frame to each asked scan's sensor.
        weights: (k,) float64 above 0 of the asked scans.
        lasers: `FiringLasers` of the scans' sensor.
        scans: (k,) int64 asked scans, of the n that the grids are of.
        fraction: (n, f) ascending sweep fractions of the scans' firings, at least two, infinite behind the
            last.
        is_hit: (n, L, f) whether each firing returned.
    """
    n = len(places_m)
    found = np.empty(n, np.float32)
    for task in prange((n + RAYS_A_TASK - 1) // RAYS_A_TASK):
        for i in range(task * RAYS_A_TASK, min(n, (task + 1) * RAYS_A_TASK)):
            px, py, pz = places_m[i, 0], places_m[i, 1], places_m[i, 2]
            total, weight = 0.0, 0.0
            for k in range(len(scans)):
                pose, scan = to_sensor[k], scans[k]
                total += weights[k] * _of_scan(
                    pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz + pose[0, 3],
                    pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz + pose[1, 3],
                    pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + pose[2, 3],
                    lasers, fraction[scan], np.searchsorted(fraction[scan], np.inf) - 1, is_hit[scan],
                )  # fmt: skip
                weight += weights[k]
            found[i] = total / weight
    return found
