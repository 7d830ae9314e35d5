"""Times of a scan's points, in the units and on the clocks that recordings have them."""

import numpy as np

from nvsf_core.drives.kitti360.frames import LONGEST_STEP_S
from nvsf_core.errors import DataError

_LONGEST_SCAN_S = LONGEST_STEP_S
"""Times farther from their frame's are of a clock, and their span is no scan's."""
_SHORTEST_SCAN_S = 1e-3
"""A LiDAR's packet takes as long; no sweep does."""
_MOST_RETURNS_A_S = 5e7
"""Several times what any LiDAR gives."""
_LEAST_TICKS = 1e12
"""Larger times are whole parts of a second also as floating-point: no clock counts as many seconds."""


def after_frame(where: str, time: np.ndarray, is_return: np.ndarray, stamp_s: float | None) -> np.ndarray:
    """Seconds (N,) after the frame's time of what a recording has: these, whole ones, or times of a clock.

    Times of a clock count from the frame's where that is on the same clock, else from the first return.

    Args:
        where: File and column, for messages.
        time: (N,) as recorded; whole numbers are nanoseconds, as drivers write them, or microseconds.
        is_return: (N,) which points count.
        stamp_s: Time of the frame; None = not known.

    Raises:
        DataError: One is not finite, or they are no scan's.
    """
    seconds = time.astype(np.float64)
    if not np.isfinite(seconds).all():
        raise DataError(f"{where}: expected a finite time of each point, found NaN or infinity")
    if not is_return.any():
        return seconds
    if np.issubdtype(time.dtype, np.integer) or np.abs(seconds[is_return]).max() > _LEAST_TICKS:
        seconds *= _tick_s(where, seconds[is_return])
    first_s, last_s = float(seconds[is_return].min()), float(seconds[is_return].max())
    middle_s = 0.5 * (first_s + last_s)
    # Of a clock that begins with the drive, the first scans' times are as small as times after the frame's.
    is_same_clock = stamp_s is not None and abs(middle_s - stamp_s) < 0.5 * abs(middle_s)
    if max(-first_s, last_s) <= _LONGEST_SCAN_S and not is_same_clock:
        return seconds
    # Single precision is coarser than a hundredth of a sweep from some hours on.
    if last_s - first_s > _LONGEST_SCAN_S or (
        time.dtype.itemsize < 8 and np.spacing(np.float32(last_s)) > 1e-3
    ):
        raise DataError(
            f"{where}: expected times of one scan, within {_LONGEST_SCAN_S:g} s: seconds, or whole "
            f"nanoseconds, after the frame's time or of a clock (then as double or 64-bit integers), found "
            f"{first_s:.10g} to {last_s:.10g} s as {time.dtype}; correct their unit or type"
        )
    is_near = stamp_s is not None and abs(first_s - stamp_s) <= _LONGEST_SCAN_S
    return seconds - (stamp_s if stamp_s is not None and is_near else first_s)


def _tick_s(where: str, ticks: np.ndarray) -> float:
    """Seconds of a whole number: 1e-9, or 1e-6 where a scan by nanoseconds would be too fast for any LiDAR.

    Raises:
        DataError: Neither makes a scan of them.
    """
    span = float(np.ptp(ticks))
    if span == 0.0 or 1e-9 * span >= _SHORTEST_SCAN_S:
        return 1e-9
    if len(ticks) > _MOST_RETURNS_A_S * 1e-9 * span and 1e-6 * span >= _SHORTEST_SCAN_S:
        return 1e-6
    raise DataError(
        f"{where}: expected times of one scan, of {_SHORTEST_SCAN_S:g} s at least, found {len(ticks):,} "
        f"returns in {1e-9 * span:.3g} s, as whole numbers are nanoseconds; write these, or floating-point "
        "seconds"
    )
