"""Errors over the elements of two arrays: RMSE, median absolute error, PSNR."""

import math

import numpy as np

from nvsf_core.errors import ShapeError
from nvsf_core.metrics.measure import Measure, fault

PSNR_CAP_DB = 80.0
"""PSNR of a perfect prediction: mean squared errors below 1e-8 of the squared peak count as 1e-8."""


def rmse(predicted: np.ndarray, truth: np.ndarray) -> Measure:
    """Root mean squared difference of two arrays of one shape, in their unit."""
    return _fault(predicted, truth) or Measure(math.sqrt(_mean_square(predicted, truth)), truth.size)


def median_abs_error(predicted: np.ndarray, truth: np.ndarray) -> Measure:
    """Median of |predicted - truth| of two arrays of one shape, in their unit."""
    bad = _fault(predicted, truth)
    if bad is not None:
        return bad
    errors = np.abs(predicted.astype(np.float64) - truth)
    return Measure(float(np.median(errors)), truth.size)


def psnr(predicted: np.ndarray, truth: np.ndarray, peak: float) -> Measure:
    """10 log10(peak^2 / MSE) in dB of two arrays of one shape, at most `PSNR_CAP_DB`.

    `peak` is the largest value that is possible, in the arrays' unit.

    Raises:
        ValueError: The peak is not above 0.
    """
    if not peak > 0.0:
        raise ValueError(f"psnr: expected a peak above 0, found {peak}; pass the largest value there can be")
    bad = _fault(predicted, truth)
    if bad is not None:
        return bad
    relative = max(_mean_square(predicted, truth) / peak**2, 10.0 ** (-PSNR_CAP_DB / 10.0))
    return Measure(-10.0 * math.log10(relative), truth.size)


def _mean_square(predicted: np.ndarray, truth: np.ndarray) -> float:
    return float(np.mean(np.square(predicted.astype(np.float64) - truth)))


def _fault(predicted: np.ndarray, truth: np.ndarray) -> Measure | None:
    same_shape(predicted, truth)
    return fault(predicted, truth)


def same_shape(predicted: np.ndarray, truth: np.ndarray) -> None:
    """Refuse arrays of different shapes, which numpy might broadcast.

    Raises:
        ShapeError: The shapes differ.
    """
    if predicted.shape != truth.shape:
        raise ShapeError(
            f"metrics compare equal shapes: prediction {predicted.shape}, truth {truth.shape}; "
            "the prediction was rendered for another frame or sensor: render it again"
        )
