"""How much brighter each laser of the recording sensor sees the same surface than its fellows."""

import numpy as np

from nvsf_core.evidence.static.voxels import index_points

_VOXEL_M = 0.2
_MOST_RETURNS = 1_000_000
_ITERATIONS = 3
_BRIGHTEST = 0.98
"""Returns above it are clipped: they say nothing of a gain."""
_PRIOR_RETURNS = 30.0
"""A laser needs many more returns than this, of mean brightness, to be believed to differ."""
_LIMITS = (0.25, 4.0)
_LEAST_RMS = 0.09
"""Lasers that are alike differ by 7 %, as each sees surfaces at its own slant: less is not believed."""


def learn_intensity_gain(
    points_m: np.ndarray, intensity: np.ndarray, laser: np.ndarray, lasers: int
) -> np.ndarray:
    """Gain (lasers,) float64 by which a laser's intensities are to be divided; 1 without evidence.

    Minimises the sum of (I - g_l m_v)^2 over a gain a laser and a brightness a voxel, in turns.

    Args:
        points_m: (n, 3) of returns, scene-local.
        intensity: (n,) recorded, 0..1.
        laser: (n,) 0 .. lasers - 1, or -1 where unknown: such returns are left out.
        lasers: How many there are.
    """
    usable = np.flatnonzero((laser >= 0) & (intensity < _BRIGHTEST))
    usable = usable[:: max(1, len(usable) // _MOST_RETURNS)]
    gain = np.ones(lasers)
    if len(usable) == 0:
        return gain
    index, voxel = index_points(points_m[usable], _VOXEL_M)
    shine, source = intensity[usable].astype(np.float64), laser[usable].astype(np.int64)
    prior = _PRIOR_RETURNS * float(np.mean(shine**2))
    if prior == 0.0:
        return gain
    for _ in range(_ITERATIONS):
        own = gain[source]
        summed = np.bincount(voxel, weights=own * shine, minlength=index.count)
        mean = (summed / np.bincount(voxel, weights=own**2, minlength=index.count))[voxel]
        products = np.bincount(source, weights=mean * shine, minlength=lasers) + prior
        gain = products / (np.bincount(source, weights=mean**2, minlength=lasers) + prior)
        gain = np.clip(gain / np.mean(gain), *_LIMITS)
    return gain if np.sqrt(np.mean((gain - 1.0) ** 2)) >= _LEAST_RMS else np.ones(lasers)
