"""Structural similarity in the LiDAR papers' variant, scikit-image's default."""

import numpy as np
from scipy.ndimage import minimum_filter, uniform_filter

from nvsf_core.metrics.elementwise import same_shape
from nvsf_core.metrics.measure import Measure, fault, undefined

WINDOW = 7
"""Side of the uniform window, pixels."""


def ssim(
    predicted: np.ndarray, truth: np.ndarray, data_range: float, valid: np.ndarray | None = None
) -> Measure:
    """Mean SSIM (Wang et al. 2004) over all 7x7 windows inside the image.

    Uniform weights, sample covariance (n - 1), K1 = 0.01, K2 = 0.03, float64:
    (2 mp mt + c1)(2 cov + c2) / ((mp^2 + mt^2 + c1)(vp + vt + c2)), c = (K data_range)^2.

    Args:
        predicted: Image (H, W) or (H, W, C); the SSIM of channels is averaged.
        truth: Image of the same shape.
        data_range: Largest minus smallest value that the truth can take.
        valid: (H, W) bool; windows with a pixel that is not valid are left out. None = all valid.

    Returns:
        Value in [-1, 1], undefined for a data range of 0 or without a window; `n_valid` = number of windows.

    Raises:
        ShapeError: The shapes differ.
    """
    same_shape(predicted, truth)
    bad = fault(predicted, truth)
    if bad is not None:
        return bad
    if min(truth.shape[:2]) < WINDOW:
        return undefined(f"image {truth.shape[:2]} is smaller than the {WINDOW}x{WINDOW} window")
    if data_range <= 0.0:
        return undefined("the true image is constant: SSIM is 0/0")
    inside = _windows_inside(truth.shape[:2], valid)
    if not inside.any():
        return undefined(f"no {WINDOW}x{WINDOW} window of valid pixels")
    channels = (np.moveaxis(image.reshape(*truth.shape[:2], -1), 2, 0) for image in (predicted, truth))
    values = [float(_ssim_map(p, t, data_range)[inside].mean()) for p, t in zip(*channels, strict=True)]
    return Measure(float(np.mean(values)), int(inside.sum()))


def _ssim_map(predicted: np.ndarray, truth: np.ndarray, data_range: float) -> np.ndarray:
    """SSIM of the window centred at each pixel, (H, W)."""
    p, t = predicted.astype(np.float64), truth.astype(np.float64)
    sample = WINDOW**2 / (WINDOW**2 - 1.0)
    mean_p, mean_t = uniform_filter(p, WINDOW), uniform_filter(t, WINDOW)
    var_p = sample * (uniform_filter(p * p, WINDOW) - mean_p**2)
    var_t = sample * (uniform_filter(t * t, WINDOW) - mean_t**2)
    covariance = sample * (uniform_filter(p * t, WINDOW) - mean_p * mean_t)
    # In a nearly constant window these differences of squares are rounding errors of any sign, and their
    # quotient could be anything. A variance is never negative, |covariance| never above sqrt(var_p var_t).
    var_p, var_t = np.maximum(var_p, 0.0), np.maximum(var_t, 0.0)
    most = np.sqrt(var_p * var_t)
    covariance = np.clip(covariance, -most, most)
    c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
    above = (2.0 * mean_p * mean_t + c1) * (2.0 * covariance + c2)
    return above / ((mean_p**2 + mean_t**2 + c1) * (var_p + var_t + c2))


def _windows_inside(shape: tuple[int, ...], valid: np.ndarray | None) -> np.ndarray:
    """(H, W) bool: centres whose window is inside the image and has valid pixels only."""
    inside = np.zeros(shape, dtype=bool)
    edge = WINDOW // 2
    inside[edge : shape[0] - edge, edge : shape[1] - edge] = True
    if valid is not None:
        inside &= minimum_filter(valid.astype(np.uint8), WINDOW).astype(bool)
    return inside
