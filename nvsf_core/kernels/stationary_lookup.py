"""Rays of a sweep looked up in scans recorded from nearly the same place, and combined; numba on the CPU.

Sums of single-precision values are in numpy's order (pairwise): so results have the bits that its operations
on whole arrays would give, in a tenth of the time.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit, prange

NOISE_M = 0.02
"""Noise of a measured range: a sensor that moved less than this is taken as in the same place."""
FOOTPRINT_STEPS = 1.5
"""How far a ray may be off and still count as the same, in angles from firing to firing."""
_AGREE_M, _AGREE_PER_RANGE = np.float32(0.1), np.float32(0.005)
"""Two ranges of one surface differ by less: metres, plus metres per metre of range."""
_STILL_M2 = np.float32(0.02**2)
"""Where the sensor moved less than 2 cm, a trend of the ranges is noise and is not followed."""
_FARTHEST_M = np.float32(1e3)
_ZERO, _ONE, _TINY = np.float32(0.0), np.float32(1.0), np.float32(1e-6)
"""With a Python number, or an integer, numba would compute in double precision."""
_RAYS_A_TASK = 1024


class NearScans(NamedTuple):
    """k scans from nearly the same place, the nearest in time first."""

    row: np.ndarray
    """(k,) int64: where they stand among the m kept scans."""
    range_m: np.ndarray
    """(m, lasers, f) float32 metres of all kept scans; 0 = no return."""
    intensity: np.ndarray
    """(m, lasers, f) float32."""
    fraction: np.ndarray
    """(k, f) float32: when they fired, ascending, in sweeps after their poses' instants."""
    firings: np.ndarray
    """(k,) int64."""
    moved_m: np.ndarray
    """(k, p + 1) float64: how far the sensor was away at p + 1 even moments of a sweep; negative for earlier
    scans."""
    turned_rad: np.ndarray
    """(k, p + 1) float64: by how much it was turned."""
    weight: np.ndarray
    """(k,) float32: 1 for a scan one frame away, less farther away."""
    is_beside: np.ndarray
    """(k,) bool: whether it is one of the scans beside the sweep."""


@njit(parallel=True, cache=True, nogil=True)
def combine_stationary(laser, fraction, rendered, scans, is_copied):  # type: ignore[no-untyped-def]
    """Replace what surfels show of rays by what scans measured along them, where any did.

    Args:
        laser: (r,) int64 row of the scans' grids.
        fraction: (r,) float64 sweeps after the pose's instant.
        rendered: Range (infinite = no surface), hit probability, intensity, each (r,) float32; overwritten.
        scans: `NearScans`.
        is_copied: Whether the nearest scan's values are copied; else all are combined, see
            `nvsf_core.evidence.stationary_scans`.
    """
    surface_m, hit, shine = rendered
    count, n = len(scans.row), len(laser)
    for task in prange((n + _RAYS_A_TASK - 1) // _RAYS_A_TASK):
        # Range, intensity, weight and offset in each scan; room for sums.
        found = np.empty((4, count), np.float32)
        room, member = np.empty(count, np.float32), np.empty(count, np.float32)
        for i in range(task * _RAYS_A_TASK, min(n, (task + 1) * _RAYS_A_TASK)):
            if not _look_up(laser[i], fraction[i], surface_m[i], scans, found):
                continue
            if is_copied:
                k = 0
                while found[2, k] == _ZERO:
                    k += 1
                hit[i] = _ONE if found[0, k] > _ZERO else _ZERO
                if found[0, k] > _ZERO:
                    surface_m[i], shine[i] = found[0, k], found[1, k]
            else:
                surface_m[i], hit[i], shine[i] = _combined(
                    found, scans.is_beside, (surface_m[i], hit[i], shine[i]), room, member
                )


@njit(cache=True, nogil=True)
def _look_up(laser, when, surface_m, scans, found):  # type: ignore[no-untyped-def]
    """Write range, intensity, weight and offset (4, k) of a ray in each scan; whether any fired it, too."""
    parts = scans.moved_m.shape[1] - 1
    cell = min(max(int((when + 0.5) * parts), 0), parts - 1)
    share, any_did = when - (cell / parts - 0.5), False
    for k in range(len(scans.row)):
        row, firings = scans.row[k], scans.firings[k]
        column = _nearest_firing(when, scans.fraction[k], firings)
        measured = scans.range_m[row, laser, column]
        reach_m = measured if measured > _ZERO else min(surface_m, _FARTHEST_M)
        moved_m = np.float32(_between(scans.moved_m[k], cell, share, parts))
        off_m = abs(moved_m) + _between(scans.turned_rad[k], cell, share, parts) * float(reach_m)
        step = np.float32(FOOTPRINT_STEPS * (2.0 * math.pi / firings))
        is_same = off_m < float(np.float32(NOISE_M) + step * reach_m)
        found[0, k], found[1, k], found[3, k] = measured, scans.intensity[row, laser, column], moved_m
        found[2, k] = scans.weight[k] if is_same else _ZERO
        any_did = any_did or is_same
    return any_did


@njit(cache=True, nogil=True)
def _between(values, cell, share, parts):  # type: ignore[no-untyped-def]
    """Values at even moments, interpolated linearly; the last one's beyond them."""
    if share <= 0.0:
        return values[cell]
    if share >= 1.0 / parts:
        return values[cell + 1]
    return (values[cell + 1] - values[cell]) / (1.0 / parts) * share + values[cell]


@njit(cache=True, nogil=True)
def _nearest_firing(when, fraction, firings):  # type: ignore[no-untyped-def]
    """As `DropPrior.nearest_firing`; the search starts where the firing of an even sweep would be."""
    right = min(max(int((when + 0.5) * firings), 0), firings - 1)
    while right > 0 and float(fraction[right - 1]) >= when:
        right -= 1
    while right < firings - 1 and float(fraction[right]) < when:
        right += 1
    left = max(right - 1, 0)
    return left if when - float(fraction[left]) < float(fraction[right]) - when else right


@njit(cache=True, nogil=True)
def _combined(found, is_beside, rendered, room, member):  # type: ignore[no-untyped-def]
    """Range, hit probability and intensity of a ray by its values (4, k) in the scans and by surfels."""
    (surface_m, hit, shine), count = rendered, found.shape[1]
    measured, intensity, weight, moved_m = found[0], found[1], found[2], found[3]
    for k in range(count):
        room[k] = weight[k] if measured[k] > _ZERO else _ZERO
    returns = (_sum(room, count) + hit) / (_sum(weight, count) + _ONE)
    of_surface = (
        1.0 if np.isfinite(surface_m) and not _is_stale(measured, weight, is_beside, surface_m) else 0.0
    )
    best, support = 0, -1.0
    for k in range(count):
        own_support = 0.0
        if measured[k] > _ZERO and weight[k] > _ZERO:
            total = _ZERO
            for j in range(count):
                if measured[j] > _ZERO and abs(measured[j] - measured[k]) < _near_m(measured[k]):
                    total += weight[j]
            own_support = float(total)
            if abs(surface_m - measured[k]) < _near_m(measured[k]):
                own_support += of_surface
        if own_support > support:
            best, support = k, own_support
    for k in range(count):
        is_near = measured[k] > _ZERO and abs(surface_m - measured[k]) < _near_m(measured[k])
        room[k] = weight[k] if is_near else _ZERO
    own = of_surface + float(_sum(room, count)) * of_surface
    is_measured = weight[best] > _ZERO and measured[best] > _ZERO
    is_measured = is_measured and (support > own or abs(surface_m - measured[best]) < _near_m(measured[best]))
    if not is_measured:
        return surface_m, returns, shine
    for k in range(count):
        is_same = measured[k] > _ZERO and abs(measured[best] - measured[k]) < _near_m(measured[k])
        member[k] = weight[k] if is_same else _ZERO
    whole = max(_sum(member, count), _TINY)
    for k in range(count):
        room[k] = member[k] * intensity[k]
    seen = _sum(room, count) / whole
    return _level(member, moved_m, measured, whole, room), returns, seen


@njit(cache=True, nogil=True)
def _near_m(range_m):  # type: ignore[no-untyped-def]
    return _AGREE_M + _AGREE_PER_RANGE * range_m


@njit(cache=True, nogil=True)
def _is_stale(measured, weight, is_beside, surface_m):  # type: ignore[no-untyped-def]
    """Whether the scans beside the sweep disagree with the surfels, and scans farther away agree.

    Then something has moved, and the surfels, which show another time, do not count.
    """
    now, agrees_now, then = False, False, False
    for k in range(len(measured)):
        if measured[k] > _ZERO and weight[k] > _ZERO:
            agrees = abs(surface_m - measured[k]) < _near_m(measured[k])
            if is_beside[k]:
                now, agrees_now = True, agrees_now or agrees
            else:
                then = then or agrees
    return now and not agrees_now and then


@njit(cache=True, nogil=True)
def _level(weight, moved_m, range_m, whole, room):  # type: ignore[no-untyped-def]
    """Range at the sweep's own pose, by a weighted line through ranges (k,) over offsets (k,)."""
    count = len(weight)
    for k in range(count):
        room[k] = weight[k] * moved_m[k]
    moved = _sum(room, count) / whole
    for k in range(count):
        room[k] = weight[k] * range_m[k]
    mean = _sum(room, count) / whole
    for k in range(count):
        room[k] = weight[k] * ((moved_m[k] - moved) * (moved_m[k] - moved))
    spread = _sum(room, count) / whole
    for k in range(count):
        room[k] = weight[k] * (moved_m[k] - moved) * (range_m[k] - mean)
    slope = _sum(room, count) / whole
    return mean - moved * slope / (spread + _STILL_M2)


@njit(cache=True, nogil=True)
def _sum(values, count):  # type: ignore[no-untyped-def]
    """Sum of some single-precision values in numpy's order: eight at a time, then the rest."""
    total, first = _ZERO, 0
    if count >= 8:
        total = ((values[0] + values[1]) + (values[2] + values[3])) + (
            (values[4] + values[5]) + (values[6] + values[7])
        )
        first = 8
    for i in range(first, count):
        total += values[i]
    return total
