"""The path that a view's scans themselves show, against the commanded one, beside the recorded drive's."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nvsf_core.clouds.odometry import odometry_path
from nvsf_core.errors import DataError, MissingLibraryError
from nvsf_core.metrics.measure import Measure, absent
from nvsf_core.metrics.trust.path_error import step_error_m
from nvsf_core.recording.drive import Sweeps
from nvsf_core.sensors.sweep import sweep_fraction
from nvsf_core.sensors.sweep_clock import SweepClock
from nvsf_core.stages.scoring.lidar import part
from nvsf_core.stores.arrays import holds_array, read_arrays

_LEAST_SCANS = 8
"""Fewer tell nothing: KISS-ICP needs some scans to learn how the sensor moves."""
_LARGEST_STEP = 1.5
"""Scans that lie farther apart, in steps of the recording, are not consecutive."""
_SETTLED = 3
"""First scans whose steps do not count: nothing is known of the motion yet."""


def odometry_errors(path: Path, sweeps: Sweeps) -> tuple[Measure, Measure]:
    """Median error of a step of KISS-ICP's path over a view's scans, and over the recorded ones beside them.

    Both are absent, with the reason, where KISS-ICP is not installed, or the view has no consecutive scans.
    """
    a = read_arrays(path, "frame", "path_time_s", "offsets", "points_m", "lidar_to_world")
    step_s = float(np.median(np.diff(sweeps.arrays["time_s"]))) if sweeps.count > 1 else np.inf
    # Of the path: the scene may stand still meanwhile.
    steps_s = np.diff(a["path_time_s"])
    if len(steps_s) + 1 < _LEAST_SCANS or not ((steps_s > 0) & (steps_s < _LARGEST_STEP * step_s)).all():
        reason = absent(f"a path needs {_LEAST_SCANS} or more consecutive scans; ask for all frames")
        return reason, reason
    clocks = read_arrays(path, "sweep_clock")["sweep_clock"] if holds_array(path, "sweep_clock") else None
    is_timed = sweeps.period_s > 0.0
    rendered = [
        _timed(a["points_m"][part(a["offsets"], i)], SweepClock.stored(clocks, i), is_timed)
        for i in range(len(a["frame"]))
    ]
    try:
        mine = _error(rendered, a["lidar_to_world"])
    except (DataError, MissingLibraryError) as error:
        return absent(str(error)), absent(str(error))
    rows = np.flatnonzero(np.isin(sweeps.arrays["frame"], a["frame"]))
    if len(rows) < _LEAST_SCANS:
        return mine, absent("too few of these frames were recorded")
    recorded = [
        _timed(sweeps.arrays["points_m"][sweeps.returns_of(k)], sweeps.clock_of(k), is_timed)
        for k in rows.tolist()
    ]
    try:
        return mine, _error(recorded, sweeps.arrays["lidar_to_world"][rows])
    except DataError as error:
        return mine, absent(str(error))


def _error(scans: Sequence[tuple[np.ndarray, np.ndarray]], poses: np.ndarray) -> Measure:
    estimated = odometry_path(scans)
    return Measure(step_error_m(estimated[_SETTLED:], poses[_SETTLED:]), len(poses) - 1 - _SETTLED)


def _timed(points_m: np.ndarray, clock: SweepClock, is_timed: bool) -> tuple[np.ndarray, np.ndarray]:
    """Points and when in the sweep they are measured; all at once where a drive is not to be compensated."""
    if not is_timed:
        return points_m, np.zeros(len(points_m))
    return points_m, clock.elapsed(sweep_fraction(np.arctan2(points_m[:, 1], points_m[:, 0])))
