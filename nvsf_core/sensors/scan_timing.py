"""Laser, firing and time of each return of a scan: as recorded, or recovered from the points alone."""

from dataclasses import dataclass

import numpy as np

from nvsf_core.sensors.lasers import UNKNOWN, nearest_laser, recover_firings, recover_lasers
from nvsf_core.sensors.sweep import sweep_fraction
from nvsf_core.sensors.sweep_clock import SweepClock, find_clock
from nvsf_core.sensors.tables import LaserTable

RING = "ring"
"""`ScanTiming.source` of lasers that the recording gives."""
_LEAST_VOTES = 0.9
"""Least share of a ring's returns that must lie on its laser of the table."""
_OWN_ROOM = 0.75
"""A ring farther from its laser than so much of the gap to that laser's next is of one not in the table."""
_LEAST_OWN_RAD = np.deg2rad(0.15)
"""Nearer than this a ring is its laser's: sensors' data sheets are no more exact."""
_BESIDE_CLOCK = 0.05
"""Sweeps by which a return's time may differ from its clock's."""


@dataclass(frozen=True, slots=True, eq=False)
class ScanTiming:
    """Lasers, firings and times of one scan of N returns."""

    laser: np.ndarray
    """(N,) int16, 0 on top, -1 unknown."""
    firing: np.ndarray
    """(N,) int16, number within the sweep, clockwise from behind, -1 unknown."""
    firings: int
    """Number of firings in the sweep, 0 unknown."""
    sweep_fraction: np.ndarray
    """(N,) float64 in [-0.5, 0.5): -azimuth / 2 pi, of the firing where it is known, else of the point."""
    elapsed: np.ndarray
    """(N,) float64 sweeps after the pose's instant, as recorded; else the same as `sweep_fraction`."""
    clock: SweepClock
    """When in the sweep each azimuth is measured."""
    source: str
    """How lasers were recovered: `ring`, `file_order`, `beam_table` or `unknown`."""
    evidence: str
    """Why, in words and numbers."""

    @property
    def share_beside_clock(self) -> float:
        """Share of returns whose times are not those of the clock."""
        apart = np.abs(self.elapsed - self.clock.elapsed(self.sweep_fraction))
        return float((apart > _BESIDE_CLOCK).mean()) if len(apart) else 0.0


def scan_timing(
    points_m: np.ndarray,
    table: LaserTable,
    *,
    ring: np.ndarray | None = None,
    offset_s: np.ndarray | None = None,
    period_s: float = 0.0,
) -> ScanTiming:
    """Lasers, firings and times of one scan, from what is recorded; what is not is recovered without it.

    Recordings number lasers from the top, from below, or in order of firing, so a ring is the laser of the
    table on which its returns lie. One without a laser of its own there, as where it had too few returns to
    be found, has laser -1; `ring` is not believed where a tenth of the returns is beside the lasers so given.

    Args:
        points_m: (N, 3) in file order, metres, sensor's frame.
        table: The sensor.
        ring: (N,) laser of each return as recorded; None = not recorded.
        offset_s: (N,) seconds after the frame's instant; None = not recorded.
        period_s: Duration of a sweep, for `offset_s`; 0 = as if it were not recorded.

    Raises:
        ShapeError: Points are not (N, 3).
    """
    laser, source, evidence = _lasers(points_m, table, ring)
    firing, firing_azimuth_rad, said = recover_firings(points_m, laser, table)
    azimuth_rad = np.arctan2(points_m[:, 1], points_m[:, 0]).astype(np.float64)
    if len(firing_azimuth_rad):
        azimuth_rad = np.where(firing >= 0, firing_azimuth_rad[firing], azimuth_rad)
    fraction = sweep_fraction(azimuth_rad)
    elapsed, clock, words = fraction, SweepClock(), "times from the azimuth"
    if offset_s is not None and period_s > 0.0:
        elapsed = offset_s / period_s
        found = find_clock(fraction, elapsed)
        clock = found or clock
        words = f"times as recorded: {_clock_words(found)}"
    return ScanTiming(
        laser=laser,
        firing=firing,
        firings=len(firing_azimuth_rad),
        sweep_fraction=fraction,
        elapsed=elapsed,
        clock=clock,
        source=source,
        evidence=f"{evidence}; {said or 'firings unknown'}; {words}",
    )


def _clock_words(clock: SweepClock | None) -> str:
    if clock is None:
        return "they do not follow the azimuth"
    way = "clockwise" if clock.spin > 0.0 else "counter-clockwise"
    return f"{way}, cut {abs(360.0 * clock.cut):.0f} degrees from ahead"


def _lasers(points_m: np.ndarray, table: LaserTable, ring: np.ndarray | None) -> tuple[np.ndarray, str, str]:
    if ring is None or len(points_m) == 0:
        return recover_lasers(points_m, table)
    nearest, off_rad = nearest_laser(points_m, table)
    names, number = np.unique(ring, return_inverse=True)
    votes = np.zeros((len(names), table.laser_count), np.int64)
    np.add.at(votes, (number, nearest), 1)
    chosen = votes.argmax(axis=1)
    ring_off_rad = np.array([np.median(off_rad[number == one]) for one in range(len(names))])
    without = _without_laser(table, chosen, ring_off_rad)
    agreeing = float(votes[np.arange(len(names)), chosen][~without].sum() / len(points_m))
    words = f"{len(names)} rings recorded, {agreeing:.2%} of their returns on one {table.name} laser each"
    if agreeing >= _LEAST_VOTES:
        if without.any():
            words += f", {np.count_nonzero(without)} of them without a laser in the table"
        return np.where(without, -1, chosen)[number].astype(np.int16), RING, words
    laser, source, evidence = recover_lasers(points_m, table)
    if source == UNKNOWN:
        return laser, source, f"{words}: not this sensor's; {evidence}"
    return laser, source, f"{words}: not believed; {evidence}"


def _without_laser(table: LaserTable, chosen: np.ndarray, off_rad: np.ndarray) -> np.ndarray:
    """Which rings have no laser of their own: another ring lies nearer to the one chosen, or it is too far.

    Args:
        table: The sensor.
        chosen: (R,) laser nearest to most of each ring's returns.
        off_rad: (R,) how far a ring's returns lie from the nearest lasers, the median.
    """
    nearest_first = np.lexsort((off_rad, chosen))
    is_second = np.zeros(len(chosen), np.bool_)
    is_second[nearest_first[1:]] = np.diff(chosen[nearest_first]) == 0
    gap_rad = np.abs(np.diff(table.elevation_rad, prepend=np.inf, append=-np.inf))
    room_rad = np.minimum(gap_rad[:-1], gap_rad[1:])
    own_rad = np.maximum(_OWN_ROOM * room_rad[chosen], _LEAST_OWN_RAD)
    return is_second | (off_rad > own_rad)
