"""What a recorded sweep measured in the direction of given points; numba on the CPU.

For each point the laser with the nearest elevation (e + v / r) and the firing with the nearest azimuth are
found, with the sensor's pose at that firing's time.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit, prange

SAME, THROUGH, EMPTY, BESIDE, SHINE = range(5)
"""Columns of the result: whether the point's surface was recorded; one behind it; nothing; whether the laser
returned there, averaged with the firings beside it as 1 : 2 : 1; the intensity of the point's surface."""
_SAME_M, _SAME_SHARE = 0.3, 0.02
"""Two ranges are one surface's if they differ by less than a length and a share of it: the ray beside meets
slanted surfaces elsewhere."""
_LARGEST_GAP_RAD = 0.007
"""Points farther than this from every laser were not looked at: the widest gap between lasers is 0.011."""
_NEAREST_M = 0.3
"""Points nearer to the sensor's axis are not looked up."""
_RAYS_A_TASK = 1024


class Lasers(NamedTuple):
    """l lasers that fired, from the top."""

    row: np.ndarray
    """(l,) int64 of the recorded grids."""
    elevation_rad: np.ndarray
    """(l,) float64."""
    up_m: np.ndarray
    """(l,) float64 lever arm across the ray."""
    start_m: np.ndarray
    """(l,) float64: where the ray's line crosses the sensor's axis, up_m / cos(elevation)."""
    left_m: np.ndarray
    """(l,) float64."""
    shift_rad: np.ndarray
    """(l,) float64: how far left of the common firing's angle it looks."""
    turned_up_rad: float
    """How far recorded directions are turned up on their way into the world."""


class SweepGrid(NamedTuple):
    """One recorded sweep by laser and firing."""

    rotation: np.ndarray
    """(m, 3, 3) float64 sensor to scene-local, at the middles of m equal parts of the sweep."""
    position_m: np.ndarray
    """(m, 3) float64 likewise."""
    fraction: np.ndarray
    """(f,) float32 ascending: when it fired, in sweeps after its pose's instant."""
    range_m: np.ndarray
    """(rows, >= f) float32 along the laser's ray; 0 = no return."""
    intensity: np.ndarray
    """(rows, >= f) float32."""


@njit(parallel=True, cache=True, nogil=True)
def look_up_scans(points, lasers, grid, found):  # type: ignore[no-untyped-def]
    """Add to `found` (n, 5) float32 what one sweep recorded towards points (n, 3) float32, scene-local.

    Points that are not finite are passed by. Angles are right to 0.0002, a tenth of a firing's.
    """
    row, elevation, up_m, start_m, left_m, shift_rad, turned_up_rad = lasers
    rotation, position, fraction, range_m, intensity = grid
    n, moments, firings = len(points), len(position), len(fraction)
    cos_up, sin_up = math.cos(turned_up_rad), math.sin(turned_up_rad)
    for task in prange((n + _RAYS_A_TASK - 1) // _RAYS_A_TASK):
        # Points of neighbouring rays are looked at nearly alike: each search starts where the last one ended.
        moment, laser = moments // 2, len(elevation) // 2
        for i in range(task * _RAYS_A_TASK, min(n, (task + 1) * _RAYS_A_TASK)):
            if not math.isfinite(points[i, 0]):
                continue
            flat, height, gap, looked = 0.0, 0.0, 0.0, 0.0
            for _ in range(3):
                # Where the sensor was when it looked there depends on where there is.
                sweep, there, assumed = rotation[moment], position[moment], moment
                a, b, c = points[i, 0] - there[0], points[i, 1] - there[1], points[i, 2] - there[2]
                x = sweep[0, 0] * a + sweep[1, 0] * b + sweep[2, 0] * c
                y = sweep[0, 1] * a + sweep[1, 1] * b + sweep[2, 1] * c
                z = sweep[0, 2] * a + sweep[1, 2] * b + sweep[2, 2] * c
                level = math.sqrt(x * x + y * y)
                flat, height = level * cos_up + z * sin_up, z * cos_up - level * sin_up
                if flat < _NEAREST_M:
                    break
                nearness, rises = 1.0 / math.sqrt(flat * flat + height * height), _angle(height, flat)
                laser = _nearest_laser(laser, rises, nearness, elevation, up_m)
                gap = abs(elevation[laser] + up_m[laser] * nearness - rises)
                angle = (_angle(y, x) - left_m[laser] / flat - shift_rad[laser]) / (2.0 * math.pi)
                looked = math.floor(angle + 0.5) - angle
                moment = min(max(int((looked + 0.5) * moments), 0), moments - 1)
                if abs(moment - assumed) <= 1:
                    break
            if flat < _NEAREST_M or gap > _LARGEST_GAP_RAD:
                continue
            column = _nearest_firing(looked, fraction, firings)
            rise = height - start_m[laser]
            along = math.sqrt(max(flat * flat - left_m[laser] * left_m[laser], 0.0) + rise * rise)
            recorded = range_m[row[laser]]
            shown = recorded[column]
            if shown <= 0.0:
                found[i, 2] += 1.0
            elif abs(shown - along) < _SAME_M + _SAME_SHARE * along:
                found[i, 0] += 1.0
                found[i, 4] += intensity[row[laser], column]
            elif shown > along:
                found[i, 1] += 1.0
            before, after = recorded[max(column - 1, 0)], recorded[min(column + 1, firings - 1)]
            found[i, 3] += 0.5 * (shown > 0.0) + 0.25 * (before > 0.0) + 0.25 * (after > 0.0)


@njit(inline="always")
def _angle(y, x):  # type: ignore[no-untyped-def]
    """The arc tangent of y / x in (-pi, pi] to 0.0002, by a polynomial: a third of the time."""
    high, low = max(abs(x), abs(y)), min(abs(x), abs(y))
    ratio = low / max(high, 1e-12)
    square = ratio * ratio
    angle = ((-0.0464964749 * square + 0.15931422) * square - 0.327622764) * square * ratio + ratio
    if abs(y) > abs(x):
        angle = 0.5 * math.pi - angle
    if x < 0.0:
        angle = math.pi - angle
    return -angle if y < 0.0 else angle


@njit(inline="always")
def _nearest_laser(laser, rises, nearness, elevation, up_m):  # type: ignore[no-untyped-def]
    """Elevations fall from laser to laser."""
    off = abs(elevation[laser] + up_m[laser] * nearness - rises)
    for step in (-1, 1):
        while 0 <= laser + step < len(elevation):
            beside = abs(elevation[laser + step] + up_m[laser + step] * nearness - rises)
            if beside >= off:
                break
            laser, off = laser + step, beside
    return laser


@njit(inline="always")
def _nearest_firing(looked, fraction, firings):  # type: ignore[no-untyped-def]
    """Firings are nearly even: the search starts where an even one would be."""
    column = min(max(int((looked + 0.5) * firings), 0), firings - 1)
    while column + 1 < firings and abs(fraction[column + 1] - looked) < abs(fraction[column] - looked):
        column += 1
    while column > 0 and abs(fraction[column - 1] - looked) < abs(fraction[column] - looked):
        column -= 1
    return column
