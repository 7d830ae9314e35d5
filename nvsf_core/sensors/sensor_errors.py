"""Range bias and intensity gain of each laser of the recording sensor, learned from a drive.

A laser of a real HDL-64E measures up to 9 cm too long or too short, always by the same amount: on a plane
that many lasers hit, its returns lie behind or in front of the others'. No other range error is as large.
Lasers also record the same surface at different brightness.
"""

import numpy as np

from nvsf_core.geometry.voxels import index_points
from nvsf_core.kernels.voxel_moments import voxel_moments

_VOXEL_M = 0.8
_MIN_RETURNS = 12
_MAX_THICKNESS_M = 0.05
_FLATNESS = 16.0
"""A voxel is flat where the second eigenvalue of its covariance is this many times the first."""
_MAX_RANGE_M = 50.0
_MOST_RETURNS = 600_000
_ITERATIONS = 4
_SCALE_M = 0.03
"""Scale of the robust weight of a distance e from a plane: w = 1 / (1 + (e / scale)^2)."""
_LEAST_RMS_M = 0.01
"""Smaller biases are taken as 0: voxels at corners alone make lasers differ by millimetres."""
_BLOCK_M = 3.2
"""Every other cube of this edge is in one half of the drive; its biases are held against the other half's,"""
_MOST_APART = 0.5
"""and these differ by at most this share of the biases: by .1 and .2 for a real HDL-64E, by 1.2 and 1.5 for
perfect sensors of 16 and 32 lasers that stood for long."""
_PRIOR_RETURNS = 10.0
"""Weight of the prior that a laser has no bias, in returns on planes."""


def learn_range_bias(
    origin_m: np.ndarray, direction: np.ndarray, range_m: np.ndarray, laser: np.ndarray, lasers: int
) -> np.ndarray:
    """Range bias (lasers,) float64 in metres, to be subtracted from each laser's ranges.

    0 for a laser without returns on planes, and for all where they agree to better than a centimetre. 0 for
    all, too, where two halves of the drive's places do not show the same: lasers of a sensor that stands see
    different surfaces, and corners would pass for biases.

    Minimises, over a bias b_l per laser and an offset c_v per flat voxel, the robust sum of
    (n_v . (o + (t - b_l) d - mean_v) - c_v)^2; planes are fitted again after each step.

    Args:
        origin_m: (n, 3) of each return's ray, scene-local metres.
        direction: (n, 3) unit, scene-local axes.
        range_m: (n,) metres, as recorded.
        laser: (n,) 0 .. lasers - 1, or -1 where unknown: such returns are left out.
        lasers: Number of lasers.
    """
    usable = np.flatnonzero((laser >= 0) & (range_m > 0) & (range_m < _MAX_RANGE_M))
    usable = usable[:: max(1, len(usable) // _MOST_RETURNS)]
    origin, along = origin_m[usable].astype(np.float64), direction[usable].astype(np.float64)
    measured, source = range_m[usable], laser[usable].astype(np.int64)
    bias = _fitted(origin, along, measured, source, lasers)
    if _rms(bias) < _LEAST_RMS_M:
        return np.zeros(lasers)
    block = np.floor((origin + along * measured[:, None]) / _BLOCK_M).astype(np.int64).sum(axis=1) % 2
    first, second = (
        _fitted(origin[half], along[half], measured[half], source[half], lasers)
        for half in (block == 0, block == 1)
    )
    return bias if _rms(first - second) <= _MOST_APART * _rms(bias) else np.zeros(lasers)


def _fitted(
    origin: np.ndarray, along: np.ndarray, measured: np.ndarray, laser: np.ndarray, lasers: int
) -> np.ndarray:
    """Range bias (lasers,) in metres of returns (n, 3), (n, 3), (n,), (n,), as of `learn_range_bias`."""
    bias = np.zeros(lasers)
    if len(measured) > 0:
        for _ in range(_ITERATIONS):
            bias += _step(origin + along * (measured - bias[laser])[:, None], along, laser, bias)
    return bias


def _rms(bias: np.ndarray) -> float:
    return float(np.sqrt(np.mean(bias**2)))


def _step(points: np.ndarray, direction: np.ndarray, laser: np.ndarray, bias: np.ndarray) -> np.ndarray:
    """One Gauss-Newton step (lasers,) in metres from returns (n, 3) already corrected by `bias`."""
    index, voxel = index_points(points, _VOXEL_M)
    mean, normal = _flat_voxels(points, voxel, index.voxel_count)
    flat = np.flatnonzero(np.any(normal != 0.0, axis=1)[voxel])
    lasers = len(bias)
    if len(flat) == 0:
        return np.zeros(lasers)
    voxel, laser = voxel[flat], laser[flat]
    normals = normal[voxel]
    error = np.einsum("ni,ni->n", normals, points[flat] - mean[voxel])
    slope = np.einsum("ni,ni->n", normals, direction[flat])
    weight = 1.0 / (1.0 + (error / _SCALE_M) ** 2)
    # The voxels' offsets are eliminated (Schur complement): each is a weighted mean of residuals.
    number = np.unique(voxel, return_inverse=True)[1].astype(np.int64)
    voxels = int(number.max()) + 1
    total = np.bincount(number, weights=weight)
    shared = np.bincount(number * lasers + laser, weights=weight * slope, minlength=voxels * lasers)
    shared = shared.reshape(voxels, lasers)
    offset = np.bincount(number, weights=weight * error) / total
    normal_matrix = np.diag(np.bincount(laser, weights=weight * slope**2, minlength=lasers) + _PRIOR_RETURNS)
    normal_matrix -= shared.T @ (shared / total[:, None])
    gradient = np.bincount(laser, weights=weight * slope * error, minlength=lasers) - shared.T @ offset
    return np.linalg.solve(normal_matrix, gradient - _PRIOR_RETURNS * bias)


def _flat_voxels(points: np.ndarray, voxel: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean (v, 3) of each voxel's points and unit normal (v, 3) of its plane, 0 where it is not flat."""
    returns = np.bincount(voxel, minlength=count)
    mean, covariance = voxel_moments(points, voxel, returns)
    full = np.flatnonzero(returns >= _MIN_RETURNS)
    value, vector = np.linalg.eigh(covariance[full])
    flat = (value[:, 1] > _FLATNESS * value[:, 0]) & (value[:, 0] < _MAX_THICKNESS_M**2)
    normal = np.zeros((count, 3))
    normal[full[flat]] = vector[flat, :, 0]
    return mean, normal


_GAIN_VOXEL_M = 0.2
_GAIN_MOST_RETURNS = 1_000_000
_GAIN_ITERATIONS = 3
_BRIGHTEST = 0.98
"""Brighter returns are clipped by the sensor and left out."""
_GAIN_PRIOR_RETURNS = 30.0
"""Weight of the prior that a laser has a gain of 1, in returns of mean brightness."""
_LIMITS = (0.25, 4.0)
_LEAST_RMS = 0.09
"""Smaller differences are taken as 0: equal lasers differ by 7 %, as each sees surfaces at its own slant."""


def learn_intensity_gain(
    points_m: np.ndarray, intensity: np.ndarray, laser: np.ndarray, lasers: int
) -> np.ndarray:
    """Intensity gain (lasers,) float64 by which a laser's intensities are to be divided; 1 without evidence.

    Minimises the sum of (I - g_l m_v)^2 over a gain per laser and a brightness per voxel, alternately.

    Args:
        points_m: (n, 3) of returns, scene-local metres.
        intensity: (n,) recorded, 0..1.
        laser: (n,) 0 .. lasers - 1, or -1 where unknown: such returns are left out.
        lasers: Number of lasers.
    """
    usable = np.flatnonzero((laser >= 0) & (intensity < _BRIGHTEST))
    usable = usable[:: max(1, len(usable) // _GAIN_MOST_RETURNS)]
    gain = np.ones(lasers)
    if len(usable) == 0:
        return gain
    index, voxel = index_points(points_m[usable], _GAIN_VOXEL_M)
    shine, source = intensity[usable].astype(np.float64), laser[usable].astype(np.int64)
    prior = _GAIN_PRIOR_RETURNS * float(np.mean(shine**2))
    if prior == 0.0:
        return gain
    for _ in range(_GAIN_ITERATIONS):
        own = gain[source]
        summed = np.bincount(voxel, weights=own * shine, minlength=index.voxel_count)
        mean = (summed / np.bincount(voxel, weights=own**2, minlength=index.voxel_count))[voxel]
        products = np.bincount(source, weights=mean * shine, minlength=lasers) + prior
        gain = products / (np.bincount(source, weights=mean**2, minlength=lasers) + prior)
        gain = np.clip(gain / np.mean(gain), *_LIMITS)
    return gain if np.sqrt(np.mean((gain - 1.0) ** 2)) >= _LEAST_RMS else np.ones(lasers)
