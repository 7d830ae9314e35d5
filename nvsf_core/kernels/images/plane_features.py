"""The depth network's inputs for each depth plane of a pixel, in numba; torch's are in `plane_depth`."""

import math

import numpy as np
from numba import njit

N_FEATURES = 12
"""Channels that describe a depth plane of a pixel."""
_NOTHING = np.float32(13.0)
"""Planes farther than this from the LiDAR's depth: exp(-x^2 / 2) is 0 in single precision."""
_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)


@njit(cache=True, nogil=True)
def describe_planes(agreed, lidar, inverses, scales, half):  # type: ignore[no-untyped-def]
    """Features of d depth planes of an image's pixels.

    Args:
        agreed: (d, h, w, 6) float32 of `agreement`.
        lidar: Three (h, w) float32: inverse depth from the LiDAR, 1/m; trust in it, 0..1; 1 where there is a
            return, else 0.
        inverses: (d,) float32 inverse depths of the planes, 1/m, evenly spaced.
        scales: Two float32: of differences of colours; largest distance of a plane from the LiDAR's depth, in
            planes.
        half: Half side of the window, in pixels, over which differences are averaged.

    Returns:
        (d, h, w, 12) float32 as of `plane_features`.
    """
    (prior, trust, is_known), (scale, clamp) = lidar, scales
    planes, rows, columns, _ = agreed.shape
    found = np.empty((planes, rows, columns, N_FEATURES), np.float32)
    sums = np.empty((2, columns), np.float32)
    step = inverses[1] - inverses[0]
    for d in range(planes):
        for r in range(rows):
            first_row, end_row = max(0, r - half), min(rows, r + half + 1)
            sums[:] = _ZERO
            for near in range(first_row, end_row):
                for c in range(columns):
                    sums[0, c] += agreed[d, near, c, 0]
                    sums[1, c] += agreed[d, near, c, 1]
            for c in range(columns):
                first, end = max(0, c - half), min(columns, c + half + 1)
                spread, pair = _ZERO, _ZERO
                for near in range(first, end):
                    spread += sums[0, near]
                    pair += sums[1, near]
                share = scale / np.float32((end - first) * (end_row - first_row))
                here, out = agreed[d, r, c], found[d, r, c]
                offset = (inverses[d] - prior[r, c]) / step * is_known[r, c]
                at_prior = _ZERO
                if abs(offset) < _NOTHING:
                    at_prior = np.float32(math.exp(-_HALF * offset * offset)) * is_known[r, c]
                out[0], out[1] = scale * here[0], scale * here[1]
                out[2], out[3] = share * spread, share * pair
                out[4] = here[2]
                out[5], out[6] = at_prior * trust[r, c], at_prior * (_ONE - trust[r, c])
                out[7] = min(max(offset, -clamp), clamp) / clamp
                out[8] = trust[r, c]
                out[9], out[10], out[11] = here[3], here[4], here[5]
    return found
