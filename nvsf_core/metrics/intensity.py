"""Errors of intensity (0..1): on intensity images, and along single rays."""

from collections.abc import Mapping

import numpy as np

from nvsf_core.metrics.elementwise import median_abs_error, psnr, rmse, same_shape
from nvsf_core.metrics.measure import Measure, undefined
from nvsf_core.metrics.ssim import ssim

CLAMP = (1e-6, 1.0)
"""Limits of a pano's intensities before they are compared."""


def clamped_intensity(intensity: np.ndarray) -> np.ndarray:
    """A copy of an intensity image within `CLAMP`, float64; NaN stays NaN."""
    clamped: np.ndarray = np.clip(intensity.astype(np.float64), *CLAMP)
    return clamped


def intensity_image_metrics(predicted: np.ndarray, truth: np.ndarray) -> Mapping[str, Measure]:
    """LiDAR4D's intensity metrics over all pixels (H, W): clamp [1e-6, 1], peak 1."""
    predicted, truth = clamped_intensity(predicted), clamped_intensity(truth)
    return {
        "intensity_rmse": rmse(predicted, truth),
        "intensity_medae": median_abs_error(predicted, truth),
        "intensity_psnr_db": psnr(predicted, truth, CLAMP[1]),
        "intensity_ssim": ssim(predicted, truth, float(np.ptp(truth))),
    }


def ray_intensity_metrics(
    predicted: np.ndarray, truth: np.ndarray, is_covered: np.ndarray
) -> Mapping[str, Measure]:
    """`intensity_rmse` along the recorded rays (R,) that were answered; `n_valid` = their number.

    A ray without an answer has no intensity; `range_missing` gives the share of those.
    """
    same_shape(predicted, truth)
    if truth.size and not is_covered.any():
        return {"intensity_rmse": undefined("no ray was answered")}
    return {"intensity_rmse": rmse(predicted[is_covered], truth[is_covered])}
