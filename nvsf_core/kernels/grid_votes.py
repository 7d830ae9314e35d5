"""Whether a sensor's grid of lasers and firings returned towards places: read between its cells."""

import numpy as np
from numba import njit, prange

from nvsf_core.kernels.voxel_march import RAYS_A_TASK

_TURN_RAD = 2.0 * np.pi


@njit(inline="always")
def _returned(azimuth_rad, flat_m, horizontal_offset_m, shift_rad, fraction, row):  # type: ignore[no-untyped-def]
    """Share of one laser's two firings beside a place that returned, the nearer one counting more."""
    turned = azimuth_rad - np.arcsin(min(max(horizontal_offset_m / flat_m, -1.0), 1.0)) - shift_rad
    wanted = -(turned / _TURN_RAD - np.floor(turned / _TURN_RAD + 0.5))
    right = min(max(np.searchsorted(fraction, wanted), 1), len(fraction) - 1)
    left = right - 1
    gap = fraction[right] - fraction[left]
    share = (wanted - fraction[left]) / gap if gap > 0.0 else 0.0
    share = min(max(share, 0.0), 1.0)
    return (1.0 - share) * row[left] + share * row[right]


@njit(parallel=True, cache=True)
def read_grid(  # type: ignore[no-untyped-def]
    azimuth_rad, elevation_rad, flat_m, range_m, lasers, looks_rad, vertical_offset_m, horizontal_offset_m,
    shift_rad, fraction, is_hit,
):  # fmt: skip
    """Share (v,) float32 that returned towards places: linear between two lasers and two firings of each.

    Args:
        azimuth_rad: (v,) of the places as the scan was recorded; `elevation_rad`, their horizontal distance
            `flat_m` and distance `range_m` likewise.
        elevation_rad: See above.
        flat_m: See above.
        range_m: See above.
        lasers: (l,) int64 lasers that ever return.
        looks_rad: (L,) elevations of all lasers; the following three of the table, likewise.
        vertical_offset_m: (L,).
        horizontal_offset_m: (L,).
        shift_rad: (L,) by which a laser looks ahead of the encoder.
        fraction: (f,) ascending sweep fractions of the scan's firings, at least two.
        is_hit: (L, f) whether each firing returned.
    """
    n = len(azimuth_rad)
    found = np.empty(n, np.float32)
    for task in prange((n + RAYS_A_TASK - 1) // RAYS_A_TASK):
        for i in range(task * RAYS_A_TASK, min(n, (task + 1) * RAYS_A_TASK)):
            above, below = -1, -1
            above_rad, below_rad = np.inf, np.inf
            for laser in lasers:
                apart = looks_rad[laser] + vertical_offset_m[laser] / range_m[i] - elevation_rad[i]
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
                total += own * _returned(
                    azimuth_rad[i], flat_m[i], horizontal_offset_m[laser], shift_rad[laser], fraction,
                    is_hit[laser],
                )  # fmt: skip
                weight += own
            found[i] = total / weight
    return found
