"""Lasers and times of a scan whose recording has them: `ring`, and the time of each point."""

import numpy as np

from nvsf_core.sensors.lasers import (
    UNKNOWN,
    ScanTiming,
    nearest_laser,
    recover_firings,
    recover_lasers,
)
from nvsf_core.sensors.sweep import sweep_fraction
from nvsf_core.sensors.tables import LaserTable

RING = "ring"
"""`ScanTiming.source` of lasers that the recording gives."""
_LEAST_VOTES = 0.9
"""Least share of a ring's returns that must lie on its laser of the table."""
_BESIDE_AZIMUTH = 0.25
"""Sweeps between when a return was fired and when its azimuth says so."""


def given_timing(
    points_m: np.ndarray,
    table: LaserTable,
    *,
    ring: np.ndarray | None,
    offset_s: np.ndarray | None,
    period_s: float,
) -> ScanTiming:
    """Lasers, firings and times of one scan, from what is recorded; what is not is recovered as without it.

    Recordings number lasers from the top, from below, or in order of firing, so a ring is the laser of the
    table on which its returns lie. Where two rings lie on one laser, `ring` is not believed.

    Args:
        points_m: (N, 3) in file order, metres, sensor's frame.
        table: The sensor.
        ring: (N,) laser of each return as recorded; None = not recorded.
        offset_s: (N,) seconds after the frame's instant; None = not recorded.
        period_s: Duration of a sweep.

    Raises:
        ShapeError: Points are not (N, 3).
    """
    laser, source, evidence = _lasers(points_m, table, ring)
    firing, firing_azimuth_rad, said = recover_firings(points_m, laser, table)
    if offset_s is not None and period_s > 0.0:
        fraction, words = offset_s / period_s, "times as recorded"
    else:
        azimuth_rad = np.arctan2(points_m[:, 1], points_m[:, 0]).astype(np.float64)
        if said:
            azimuth_rad = np.where(firing >= 0, firing_azimuth_rad[firing], azimuth_rad)
        fraction, words = sweep_fraction(azimuth_rad), "times from the azimuth, spinning clockwise"
    return ScanTiming(
        laser=laser,
        firing=firing,
        firings=len(firing_azimuth_rad),
        sweep_fraction=fraction,
        source=source,
        evidence=f"{evidence}; {said or 'firings unknown'}; {words}",
    )


def share_beside_azimuth(points_m: np.ndarray, fraction: np.ndarray) -> float:
    """Share of returns that were not fired when a sensor that spins clockwise and is cut behind fires there.

    Such a sensor fires at azimuth a when -a / 2 pi of a sweep has passed since its pose's instant.

    Args:
        points_m: (N, 3) metres, sensor's frame.
        fraction: (N,) sweeps after the instant of the pose, as recorded.
    """
    azimuth_rad = np.arctan2(points_m[:, 1], points_m[:, 0]).astype(np.float64)
    apart = np.abs(fraction - sweep_fraction(azimuth_rad))
    return float((apart > _BESIDE_AZIMUTH).mean()) if len(apart) else 0.0


def _lasers(points_m: np.ndarray, table: LaserTable, ring: np.ndarray | None) -> tuple[np.ndarray, str, str]:
    if ring is None or len(points_m) == 0:
        return recover_lasers(points_m, table)
    nearest, _ = nearest_laser(points_m, table)
    names, number = np.unique(ring, return_inverse=True)
    votes = np.zeros((len(names), table.laser_count), np.int64)
    np.add.at(votes, (number, nearest), 1)
    chosen = votes.argmax(axis=1)
    agreeing = float(votes[np.arange(len(names)), chosen].sum() / len(points_m))
    words = f"{len(names)} rings recorded, {agreeing:.2%} of their returns on one {table.name} laser each"
    if len(np.unique(chosen)) == len(names) and agreeing >= _LEAST_VOTES:
        return chosen[number].astype(np.int16), RING, words
    laser, source, evidence = recover_lasers(points_m, table)
    if source == UNKNOWN:
        return laser, source, f"{words}: not this sensor's; {evidence}"
    return laser, source, f"{words}: not believed; {evidence}"
