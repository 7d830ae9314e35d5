"""Errors of range and intensity: on panos, and along single rays."""

from collections.abc import Mapping

import numpy as np

from nvsf_core.metrics.elementwise import median_abs_error, psnr, rmse, same_shape
from nvsf_core.metrics.measure import Measure, undefined
from nvsf_core.metrics.ssim import ssim

CLAMP_M = (1e-6, 80.0)
"""A pano's ranges are clamped to these limits before comparison; 0 = empty becomes the lower one."""


def clamped_range_m(range_m: np.ndarray) -> np.ndarray:
    """A range image (H, W), clamped to `CLAMP_M`, as a float64 copy; NaN stays NaN."""
    return np.clip(range_m.astype(np.float64), *CLAMP_M)


def range_image_metrics(predicted_m: np.ndarray, truth_m: np.ndarray) -> Mapping[str, Measure]:
    """LiDAR4D's range metrics over all pixels of two panos (H, W); 0 = empty counts like any other value.

    Both sides are clamped to [1e-6, 80] m. PSNR has a peak of 80 m, SSIM the data range of the true pano.
    """
    predicted, truth = clamped_range_m(predicted_m), clamped_range_m(truth_m)
    return {
        "range_rmse_m": rmse(predicted, truth),
        "range_medae_m": median_abs_error(predicted, truth),
        "range_psnr_db": psnr(predicted, truth, CLAMP_M[1]),
        "range_ssim": ssim(predicted, truth, float(np.ptp(truth))),
    }


def ray_range_metrics(predicted_m: np.ndarray, truth_m: np.ndarray) -> Mapping[str, Measure]:
    """Errors of range (R,) along recorded rays; that of a ray without a predicted return (inf) is infinite.

    `range_abs_error_median_m`, `range_abs_error_p90_m` (the smallest error that at least 90 % of the rays do
    not exceed), and `range_missing`, the share of rays without a predicted return. Recorded ranges are
    finite.
    """
    same_shape(predicted_m, truth_m)
    names = ("range_abs_error_median_m", "range_abs_error_p90_m", "range_missing")
    n_nan = int(np.count_nonzero(np.isnan(predicted_m)))
    if n_nan or truth_m.size == 0:
        reason = f"{n_nan} predicted ranges are NaN" if n_nan else "no recorded ray"
        return dict.fromkeys(names, undefined(reason, truth_m.size - n_nan))
    errors_m = np.sort(np.abs(predicted_m.astype(np.float64) - truth_m))
    missing = float(np.mean(np.isinf(predicted_m)))
    # Nearest rank: interpolation between a finite and an infinite error would give NaN.
    p90_m = errors_m[int(np.ceil(0.9 * errors_m.size)) - 1]
    values = (float(np.median(errors_m)), float(p90_m), missing)
    return {name: Measure(value, truth_m.size) for name, value in zip(names, values, strict=True)}


CLAMP = (1e-6, 1.0)
"""A pano's intensities are clamped to these limits before comparison."""


def clamped_intensity(intensity: np.ndarray) -> np.ndarray:
    """An intensity image (H, W), clamped to `CLAMP`, as a float64 copy; NaN stays NaN."""
    return np.clip(intensity.astype(np.float64), *CLAMP)


def intensity_image_metrics(predicted: np.ndarray, truth: np.ndarray) -> Mapping[str, Measure]:
    """LiDAR4D's intensity metrics over all pixels of two panos (H, W), clamped to [1e-6, 1]; peak 1."""
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
    """`intensity_rmse` (of 0..1) along the rays with a predicted return; `n_valid` = their number."""
    same_shape(predicted, truth)
    if truth.size and not is_covered.any():
        return {"intensity_rmse": undefined("no ray was rendered with a return")}
    return {"intensity_rmse": rmse(predicted[is_covered], truth[is_covered])}
