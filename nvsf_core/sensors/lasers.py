"""Recovers from a scan which laser measured each return, and in which firing.

KITTI's files do not store it. They hold one laser after the other from the top, azimuth ascending within
each, so the next laser begins where the azimuth wraps. In others azimuths descend, or wrap behind. All lasers
fire together on the encoder's lattice, so each laser's columns, shifted by its own constant, give the firings
of the sweep.
"""

from collections.abc import Sequence

import numpy as np

from nvsf_core.errors import ShapeError
from nvsf_core.sensors.beam_table import encoder_angle, firing_phase, wrap_angle
from nvsf_core.sensors.tables import LaserTable

FILE_ORDER = "file_order"
BEAM_TABLE = "beam_table"
UNKNOWN = "unknown"
ROW_ORDERS = ((0.0, False), (0.0, True), (np.pi, False), (np.pi, True))
"""Azimuth, radians, at which the returns of a laser begin in a file, and whether they go on clockwise."""
_AGREEMENT = 0.9
"""Least share of returns that must agree with the beam table for it to be used."""
_RESIDUAL_RAD = np.deg2rad(0.1)
"""Real returns lie within 0.02 degrees of their laser; lasers are at least 0.25 degrees apart."""
_LOST_GAP = 2.5
"""Gaps longer than so many usual ones are lost firings; where a sweep begins, 1.6 is normal."""
_NEARLY_ALL = 0.8
"""Least share of the encoder's steps that a table's firings are where it fires at each: found tables count
those that returned."""
_MOST_STEPS_APART = 1.15
"""Largest mean gap, in steps, of firings at every step: up to 1.003 below open sky, 1.04 with a single laser;
KITTI's have 1.84."""
_LATTICE_RESIDUAL_STEPS = 0.15
"""Largest mean distance from the lattice: 0.02 in real scans, 0.25 where there is no lattice."""

_MOST_TIMES_USUAL = 4
"""Of a sensor whose encoder is not known, a rotation may have so many times its usual firings: makers let the
user choose a slower rotation, or more columns."""


def recover_lasers(points_m: np.ndarray, table: LaserTable) -> tuple[np.ndarray, str, str]:
    """Laser of each return (N,) int16, how it was recovered, and why; as `ScanTiming` has them.

    File order is used if each run of ascending (or each of descending) azimuth, from ahead or from behind,
    lies on one laser of the table, and no two on one.
    Else each return gets the laser with the nearest elevation, argmin |e - v/r - e_l|, if 90 % of the returns
    fit one within 0.1 degrees. Else lasers are unknown (-1). Points (N, 3) are in the sensor's frame, metres.
    """
    if points_m.ndim != 2 or points_m.shape[1] != 3:
        raise ShapeError(f"expected points (N, 3), found {points_m.shape}")
    if len(points_m) == 0:
        return np.zeros(0, np.int16), UNKNOWN, "an empty scan"
    nearest, residual_rad = nearest_laser(points_m, table)
    fitting = float((residual_rad < _RESIDUAL_RAD).mean())
    fit = f"{fitting:.2%} of the returns within 0.1 deg of a {table.name} laser"
    for order in ROW_ORDERS if fitting >= _AGREEMENT else ():
        row = rows_of(points_m, *order)
        laser_of_row, agreeing = _laser_of_row(row, nearest, table.laser_count)
        if agreeing >= _AGREEMENT and (np.diff(laser_of_row) > 0).all():
            turns = len(laser_of_row)
            words = f"{turns} turns of the azimuth in file order are {turns} of {table.laser_count} lasers"
            laser = _mend_seam(points_m, laser_of_row[row], nearest, residual_rad, table)
            return laser.astype(np.int16), FILE_ORDER, f"{words}, {agreeing:.2%} agree; {fit}"
    found = f"{rows_of(points_m, *ROW_ORDERS[0])[-1] + 1} turns of the azimuth, not one a laser; {fit}"
    if fitting >= _AGREEMENT:
        laser = np.where(residual_rad < _RESIDUAL_RAD, nearest, -1).astype(np.int16)
        return laser, BEAM_TABLE, found
    return np.full(len(points_m), -1, np.int16), UNKNOWN, found


def _laser_of_row(row: np.ndarray, nearest: np.ndarray, laser_count: int) -> tuple[np.ndarray, float]:
    """Laser of each row of the file by its returns' (N,) rows and nearest lasers, and the share that agrees.

    Empty and 0 where there are more rows than lasers.
    """
    rows = int(row[-1]) + 1
    if rows > laser_count:
        return np.zeros(0, np.int64), 0.0
    votes = np.zeros((rows, laser_count), np.int64)
    np.add.at(votes, (row, nearest), 1)
    laser_of_row = np.arange(rows) if rows == laser_count else votes.argmax(axis=1)
    return laser_of_row, float(votes[np.arange(rows), laser_of_row].sum() / len(row))


def is_unlike(table: LaserTable, scans_m: Sequence[np.ndarray]) -> bool:
    """Whether the returns of most scans, (n, 3) each as of `recover_lasers`, are not of a sensor's lasers."""
    sources = [recover_lasers(np.ascontiguousarray(points_m), table)[1] for points_m in scans_m]
    return 2 * sources.count(UNKNOWN) > len(sources)


def recover_firings(
    points_m: np.ndarray, laser: np.ndarray, table: LaserTable
) -> tuple[np.ndarray, np.ndarray, str]:
    """Firing of each return (points (N, 3), laser (N,)), and the firings of the sweep.

    column_l = round(theta / step - phase_l), firing column = (column_l + firing_shift_l) mod lattice. Columns
    that at least an eighth of the lasers share are the firings; a return between two belongs to the nearest.
    Of a sensor that fires at every step of its encoder all steps are, also those that look into the sky.
    Without a lattice, the sweep is divided evenly, by the spacing of the lasers' returns, about the phase on
    which they agree.

    Returns:
        firing (N,) int16, by time, -1 unknown; azimuth (F,) of the common firing columns in radians,
        descending from pi: (pi - azimuth) / 2 pi is the elapsed share of the sweep; a description.
        F = 0 and an empty text where no laser is known.
    """
    firing = np.full(len(laser), -1, np.int16)
    known = np.flatnonzero(laser >= 0)
    if len(known) == 0:
        return firing, np.zeros(0), ""
    points_m, ids = points_m[known], laser[known].astype(np.int64)
    theta_steps = encoder_angle(table, points_m, ids) / table.step_rad - table.phase_steps[ids]
    column = np.rint(theta_steps)
    residual_steps = float(np.abs(theta_steps - column).mean())
    shifted = (theta_steps + table.firing_shift_steps[ids]) * table.step_rad
    if residual_steps <= _LATTICE_RESIDUAL_STEPS:
        gone_by = table.lattice_steps // 2 - column.astype(np.int64) - table.firing_shift_steps[ids]
        elapsed = np.mod(gone_by, table.lattice_steps)
        seen = _common_columns(elapsed, ids, table.lattice_steps)
        columns = np.arange(table.lattice_steps) if _fires_at_every_step(table, seen) else _fill_gaps(seen)
        azimuth_rad: np.ndarray = np.pi - columns * table.step_rad
        firing[known] = _nearest_firing(elapsed, columns, table.lattice_steps)
        said = f"{len(columns)} firings on the encoder's lattice ({residual_steps:.3f} steps off it)"
        silent = len(columns) - len(seen)
        return firing, azimuth_rad, f"{said}, {silent} of them lost" if silent else said
    count = _firings_by_spacing(theta_steps * table.step_rad, ids)
    if count > _most_firings(table):
        said = f"{count} firings by the returns' spacing, {table.name} has at most {_most_firings(table)}"
        return firing, np.zeros(0), f"firings unknown: {said}"
    steps = (np.pi - wrap_angle(shifted)) * (count / (2.0 * np.pi))
    phase = firing_phase(steps)
    firing[known] = np.floor(steps - phase + 0.5).astype(np.int64) % count
    azimuth_rad = np.pi - (np.arange(count) + phase) * (2.0 * np.pi / count)
    return firing, azimuth_rad, f"no encoder lattice; {count} firings by the returns' spacing"


def _most_firings(table: LaserTable) -> int:
    """Most firings that a sweep may have: the encoder's steps, where they are known."""
    if table.lattice_steps > table.firings_per_turn:
        return table.lattice_steps
    return _MOST_TIMES_USUAL * table.firings_per_turn


def _mend_seam(
    points_m: np.ndarray, laser: np.ndarray, nearest: np.ndarray, nearest_rad: np.ndarray, table: LaserTable
) -> np.ndarray:
    """Laser (N,), corrected by elevation where noise moved a return past azimuth 0 to the next laser."""
    elevation, range_m = elevation_of(points_m)
    own_rad = np.abs(elevation - table.vertical_offset_m[laser] / range_m - table.elevation_rad[laser])
    return np.where((own_rad > _RESIDUAL_RAD) & (nearest_rad < _RESIDUAL_RAD), nearest, laser)


def elevation_of(points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Elevation (n,) in radians and range (n,) in metres of points (n, 3 or more): metres, x y z first."""
    x, y, z = points_m[:, :3].astype(np.float64).T
    range_m = np.maximum(np.sqrt(x * x + y * y + z * z), 1e-6)
    return np.arcsin(np.clip(z / range_m, -1.0, 1.0)), range_m


def nearest_laser(points_m: np.ndarray, table: LaserTable) -> tuple[np.ndarray, np.ndarray]:
    """Laser with the nearest elevation for each point (N, 3) in metres, and how far it is, radians."""
    elevation, range_m = elevation_of(points_m)
    best = np.zeros(len(points_m), np.int64)
    best_rad: np.ndarray = np.full(len(points_m), np.inf)
    # One laser at a time: an (N, L) table of distances would take 60 MB a scan.
    for index in range(table.laser_count):
        residual = np.abs(elevation - table.vertical_offset_m[index] / range_m - table.elevation_rad[index])
        closer = residual < best_rad
        best[closer] = index
        best_rad[closer] = residual[closer]
    return best, best_rad


def rows_of(points_m: np.ndarray, begin_rad: float, is_clockwise: bool) -> np.ndarray:
    """Row of each return (N,), in file order: how often the azimuth, going one way, has passed its begin."""
    azimuth = np.arctan2(points_m[:, 1], points_m[:, 0]).astype(np.float64) - begin_rad
    turned = np.mod(-azimuth if is_clockwise else azimuth, 2.0 * np.pi)
    return np.concatenate([[0], np.cumsum(np.diff(turned) < -np.pi)])[: len(points_m)]


def _common_columns(elapsed: np.ndarray, laser: np.ndarray, lattice_steps: int) -> np.ndarray:
    """Columns shared by at least an eighth of the lasers that returned anything: the rest is noise."""
    share = np.bincount(elapsed, minlength=lattice_steps)
    return np.flatnonzero(share >= max(1, len(np.unique(laser)) // 8))


def _fires_at_every_step(table: LaserTable, columns: np.ndarray) -> bool:
    """Whether the sensor fires at every step of its encoder: the table says so, and the columns seen do."""
    if len(columns) < 3 or table.firings_per_turn < _NEARLY_ALL * table.lattice_steps:
        return False
    return _usual_gap(np.diff(columns)) <= _MOST_STEPS_APART


def _usual_gap(gap: np.ndarray) -> float:
    """Mean of the gaps between firing columns, in steps, without those where firings are lost."""
    return float(np.mean(gap[gap <= 2 * np.median(gap)]))


def _fill_gaps(columns: np.ndarray) -> np.ndarray:
    """Insert lost firings evenly: with a lost packet, six firings of all lasers are missing.

    Without them, all later firings would have numbers six lower than in other scans.
    """
    if len(columns) < 3:
        return columns
    gap = np.diff(columns)
    usual = _usual_gap(gap)
    missing = np.where(gap > _LOST_GAP * usual, np.rint(gap / usual) - 1, 0).astype(np.int64)
    filled = [
        np.rint(np.linspace(columns[k], columns[k + 1], missing[k] + 2)[1:-1]).astype(np.int64)
        for k in np.flatnonzero(missing)
    ]
    return np.sort(np.concatenate([columns, *filled]))


def _nearest_firing(elapsed: np.ndarray, columns: np.ndarray, lattice_steps: int) -> np.ndarray:
    after = np.searchsorted(columns, elapsed) % len(columns)
    before = (after - 1) % len(columns)
    ahead = np.mod(columns[after] - elapsed, lattice_steps)
    behind = np.mod(elapsed - columns[before], lattice_steps)
    return np.where(ahead <= behind, after, before)


def _firings_by_spacing(theta_rad: np.ndarray, laser: np.ndarray) -> int:
    """Firings of a sweep, from the usual angle between neighbouring returns of a laser."""
    order = np.lexsort((theta_rad, laser))
    step = np.diff(theta_rad[order])[np.diff(laser[order]) == 0]
    step = step[step > 1e-6]
    if len(step) == 0:
        return 1
    # The mean of the single steps: a median would keep the encoder's rounding.
    return max(1, round(2.0 * np.pi / float(np.mean(step[step < 1.5 * np.median(step)]))))
