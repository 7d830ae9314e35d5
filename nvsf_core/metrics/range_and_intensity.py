"""Errors of range and of intensity (0..1): on pano images, and along single rays."""

from collections.abc import Mapping

import numpy as np

from nvsf_core.metrics.elementwise import median_abs_error, psnr, rmse, same_shape
from nvsf_core.metrics.measure import Measure, undefined
from nvsf_core.metrics.ssim import ssim

CLAMP_M = (1e-6, 80.0)
"""Limits of a pano's ranges before they are compared; 0 = empty becomes the lower one."""


def clamped_range_m(range_m: np.ndarray) -> np.ndarray:
    """A copy of a range image within `CLAMP_M`, float64; NaN stays NaN."""
    clamped: np.ndarray = np.clip(range_m.astype(np.float64), *CLAMP_M)
    return clamped


def range_image_metrics(predicted_m: np.ndarray, truth_m: np.ndarray) -> Mapping[str, Measure]:
    """LiDAR4D's range metrics over all pixels (H, W), 0 = empty counted like any other value.

    Both sides clamped to [1e-6, 80] m; PSNR with peak 80 m; SSIM with the range of the true image.
    """
    predicted, truth = clamped_range_m(predicted_m), clamped_range_m(truth_m)
    return {
        "range_rmse_m": rmse(predicted, truth),
        "range_medae_m": median_abs_error(predicted, truth),
        "range_psnr_db": psnr(predicted, truth, CLAMP_M[1]),
        "range_ssim": ssim(predicted, truth, float(np.ptp(truth))),
    }


def ray_range_metrics(predicted_m: np.ndarray, truth_m: np.ndarray) -> Mapping[str, Measure]:
    """Error of range along recorded rays, (R,) in metres; a ray without an answer is infinitely wrong.

    `range_abs_error_median_m`, `range_abs_error_p90_m` (the smallest error that at least 90 % of the
    rays keep to; infinite when more than 10 % have no answer), `range_missing` (their share).

    Args:
        predicted_m: Predicted ranges, inf = no answer.
        truth_m: Recorded ranges, finite.
    """
    same_shape(predicted_m, truth_m)
    names = ("range_abs_error_median_m", "range_abs_error_p90_m", "range_missing")
    n_nan = int(np.count_nonzero(np.isnan(predicted_m)))
    if n_nan or truth_m.size == 0:
        reason = f"{n_nan} predicted ranges are NaN" if n_nan else "no recorded ray"
        return dict.fromkeys(names, undefined(reason, truth_m.size - n_nan))
    errors_m = np.sort(np.abs(predicted_m.astype(np.float64) - truth_m))
    missing = float(np.mean(np.isinf(predicted_m)))
    # Nearest rank: interpolating between a finite and an infinite error would give NaN.
    p90_m = errors_m[int(np.ceil(0.9 * errors_m.size)) - 1]
    values = (float(np.median(errors_m)), float(p90_m), missing)
    return {name: Measure(value, truth_m.size) for name, value in zip(names, values, strict=True)}


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
