"""Range noise of a LiDAR, measured on its own scans, without knowing the surfaces.

Three firings of a laser that follow each other meet nearly one plane: of their ranges the second difference
r1 - 2 r2 + r3 is noise alone, with six times its variance. Edges and noise of other kinds are left out by the
median.
"""

import numpy as np

_NEAR_M = 30.0
"""Beyond it neighbouring firings meet surfaces too far from each other."""
_EDGE_M = 0.5
"""Larger second differences are edges."""
_NORMAL_MAD = 1.4826
"""Standard deviation of a normal distribution, in median absolute deviations."""
_FEWEST = 100


def measured_range_noise_m(
    range_m: np.ndarray, laser: np.ndarray, firing: np.ndarray, offsets: np.ndarray
) -> float:
    """Standard deviation of the range noise, metres; NaN where too few firings follow each other.

    Args:
        range_m: (N,) along each return's ray.
        laser: (N,) int, -1 = unknown.
        firing: (N,) int, number within the sweep, -1 = unknown.
        offsets: (n + 1,) int: scan k's returns are offsets[k] .. offsets[k + 1] - 1.
    """
    scan = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    known = np.flatnonzero((laser >= 0) & (firing >= 0) & (range_m > 0.0) & (range_m < _NEAR_M))
    order = known[np.lexsort((firing[known], laser[known], scan[known]))]
    first, last = order[:-2], order[2:]
    beside = (scan[first] == scan[last]) & (laser[first] == laser[last])
    beside &= firing[last].astype(np.int64) - firing[first] == 2
    bend_m = np.abs(range_m[first] - 2.0 * range_m[order[1:-1]] + range_m[last])[beside]
    bend_m = bend_m[bend_m < _EDGE_M]
    if len(bend_m) < _FEWEST:
        return float("nan")
    return float(_NORMAL_MAD * np.median(bend_m) / np.sqrt(6.0))
