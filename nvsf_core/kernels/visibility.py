"""Whether each other scan saw through a return's place, had it hidden, or confirmed it; in numba."""

import math

import numpy as np
from numba import njit, prange

_UNKNOWN, _THROUGH, _HIDDEN, _CONFIRMED = 0, 1, 2, 3
_LEAST_FILLED_SHARE = 0.55
_CHUNK = 1024
_OFF_ROW_SHARE = 0.75
_ON_ROW_SHARE = 0.25
_LEFT_SCANS = 3
"""After so many scans in a row that saw through a place, what was there has left: a later confirmation is of
another object, such as the next car of a queue."""
_MOST_GUESSES = 4
"""Of the moment at which a scan looks at a place; from scan to scan it hardly changes."""
_APART_M = 0.35
"""Where neighbouring lasers are farther apart than this, only the one that looks at a place counts, or both
between which it lies; where they are nearer together, three do."""


# Not inlined by numba: inlined, a result that was kept for later was wrong after the second call.
@njit(cache=True, fastmath=True)
def _angle(y, x):  # type: ignore[no-untyped-def]
    """Angle atan2(y, x) to 2e-6 rad (Abramowitz and Stegun 4.4.49, rearranged): five times as fast."""
    along, across = abs(x), abs(y)
    most = max(along, across)
    t = min(along, across) / most if most > 0.0 else np.float32(0.0)
    q = t * t
    a = t * (
        np.float32(0.99997726)
        + q * (
            np.float32(-0.33262347)
            + q * (
                np.float32(0.19354346)
                + q * (
                    np.float32(-0.11643287) + q * (np.float32(0.05265332) - q * np.float32(0.01172120))
                )
            )
        )
    )  # fmt: skip
    if across > along:
        a = np.float32(0.5 * math.pi) - a
    if x < 0.0:
        a = np.float32(math.pi) - a
    return -a if y < 0.0 else a


@njit(inline="always")
def _cell(azimuth, count):  # type: ignore[no-untyped-def]
    """Which of a sweep's `count` cells looks at an azimuth: -a / 2 pi of a sweep after its middle."""
    return min(max(int((np.float32(0.5) - azimuth * np.float32(0.5 / math.pi)) * count), 0), count - 1)


@njit(inline="always")
def _neighbours(elevation, range_m, laser_elevation, laser_offset_m):  # type: ignore[no-untyped-def]
    """Rows of the laser nearest to an elevation at a range and of the next one, and the angles to both.

    Row -1 beyond the outermost lasers. Just outside them the first angle is negative.
    """
    nearness = np.float32(1.0) / range_m
    low, high = 0, len(laser_elevation) - 1
    while high - low > 1:
        middle = (low + high) // 2
        if laser_elevation[middle] + laser_offset_m[middle] * nearness > elevation:
            low = middle
        else:
            high = middle
    above = laser_elevation[low] + laser_offset_m[low] * nearness - elevation
    below = elevation - laser_elevation[high] - laser_offset_m[high] * nearness
    spacing = above + below
    if above < -_OFF_ROW_SHARE * spacing or below < -_OFF_ROW_SHARE * spacing:
        return -1, -1, above, below
    if above < below:
        return low, high, above, below
    return high, low, below, above


@njit(inline="always")
def _asked(row, beside, off_row, off_beside, range_m, count):  # type: ignore[no-untyped-def]
    """First and end of the rows, of `count`, that know of a place between two neighbours."""
    spacing = off_row + off_beside
    if spacing * range_m < _APART_M:
        return max(row - 1, 0), min(row + 2, count)
    if off_row < _ON_ROW_SHARE * spacing:
        return row, row + 1
    return min(row, beside), max(row, beside) + 1


@njit(inline="always")
def _look(image, first_row, end_row, column, range_m, margin_m):  # type: ignore[no-untyped-def]
    """Compare three cells of each of some rows with a surface at this range."""
    cells = image.shape[1]
    filled, farther, nearer = 0, 0, 0
    for i in range(first_row, end_row):
        for k in range(column - 1, column + 2):
            found = image[i, k % cells]
            if found > 0.0:
                filled += 1
                if found > range_m + margin_m:
                    farther += 1
                elif found < range_m - margin_m:
                    nearer += 1
    if filled < _LEAST_FILLED_SHARE * 3 * (end_row - first_row):
        return _UNKNOWN
    if farther == filled:
        return _THROUGH
    if nearer == filled:
        return _HIDDEN
    return _CONFIRMED if farther + nearer < filled else _UNKNOWN


# Wide: two rows, the angles to both, and a place.
@njit(inline="always")
def _may_be_sheet(  # type: ignore[no-untyped-def]
    image, row, beside, off_row, off_beside, column, least_range_m
):
    """Whether a surface that two neighbouring rows met may be at the place, no farther than this range.

    A ceiling at a grazing angle comes metres nearer from one row to the next. Between the rows a surface may
    bend, as a bonnet does, and have any range from one row's to the other's. Beyond the outermost row it is
    taken to run on straight: then 1 / range is linear in the angle. A row without a return says nothing.
    """
    cells = image.shape[1]
    nearness = (off_row + off_beside) / least_range_m
    for k in range(column - 1, column + 2):
        found, found_beside = image[row, k % cells], image[beside, k % cells]
        if found_beside <= 0.0:
            continue
        if off_row >= 0.0:
            if found_beside <= least_range_m:
                return True
        elif found > 0.0 and off_beside / found + off_row / found_beside >= nearness:
            return True
    return False


@njit(inline="always")
def _ask(  # type: ignore[no-untyped-def]
    image, column, elevation, range_m, margin_m, laser_elevation, laser_offset_m
):
    """What a scan's image says of a surface at a place."""
    row, beside, off_row, off_beside = _neighbours(elevation, range_m, laser_elevation, laser_offset_m)
    if row < 0:
        return _UNKNOWN
    first_row, end_row = _asked(row, beside, off_row, off_beside, range_m, len(laser_elevation))
    seen = _look(image, first_row, end_row, column, range_m, margin_m)
    if seen == _THROUGH and _may_be_sheet(
        image, row, beside, off_row, off_beside, column, range_m + margin_m
    ):
        return _UNKNOWN
    return seen


@njit(parallel=True, cache=True, nogil=True)
def look_back(  # type: ignore[no-untyped-def]
    points, scans, images, to_sensor, lasers, near_m, per_range
):
    """Walk from each point's own scan outwards in time, in both directions.

    Args:
        points: (m, 3) float32, scene-local.
        scans: (m,) int32, of the points.
        images: (n, l, cells) float32 range from the sensor's centre, 0 where nothing returned.
        to_sensor: (n, k, 3, 4) float32 from the scene at k moments of each sweep.
        lasers: Elevations (l,) and vertical offsets (l,) float32 from the top, at least two; and the angle by
            which the sensor's rays were turned up on their way into the scene.
        near_m: Two ranges show one surface within near_m + per_range * range.
        per_range: Likewise.

    Returns:
        (m, 3) int16: scans that saw through the point; scans that confirmed it although one nearer to it
        in time, in that direction, had seen through, until three in a row did; scans that confirmed it.
    """
    n, _, cells = images.shape
    laser_elevation, laser_offset_m, turn_down_rad = lasers
    moments = to_sensor.shape[1]
    sine, cosine = np.float32(math.sin(turn_down_rad)), np.float32(math.cos(turn_down_rad))
    counts = np.zeros((len(points), 3), np.int16)
    for chunk in prange((len(points) + _CHUNK - 1) // _CHUNK):
        for point in range(chunk * _CHUNK, min(len(points), (chunk + 1) * _CHUNK)):
            px, py, pz = points[point, 0], points[point, 1], points[point, 2]
            for direction in (-1, 1):
                moment = moments // 2
                gone, left, through = False, False, 0
                scan = scans[point] + direction
                while 0 <= scan < n:
                    # The moment depends on where the point is seen, which depends on the moment.
                    for _ in range(_MOST_GUESSES):
                        pose = to_sensor[scan, moment]
                        x = pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz + pose[0, 3]
                        y = pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz + pose[1, 3]
                        azimuth = _angle(y, x)
                        looking = _cell(azimuth, moments)
                        if looking == moment:
                            break
                        moment = looking
                    z = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + pose[2, 3]
                    flat = math.sqrt(x * x + y * y)
                    range_m = math.sqrt(x * x + y * y + z * z)
                    elevation = _angle(z * cosine - flat * sine, flat * cosine + z * sine)
                    seen = _ask(
                        images[scan],
                        _cell(azimuth, cells),
                        elevation,
                        range_m,
                        np.float32(near_m) + np.float32(per_range) * range_m,
                        laser_elevation,
                        laser_offset_m,
                    )
                    if seen == _THROUGH:
                        gone = True
                        through += 1
                        left = left or through >= _LEFT_SCANS
                        counts[point, 0] += 1
                    elif seen == _CONFIRMED:
                        through = 0
                        counts[point, 2] += 1
                        if gone and not left:
                            counts[point, 1] += 1
                    scan += direction
    return counts
