"""PSNR, SSIM, LPIPS, hits and ranges: empty masks, constant images, one pixel, NaN."""

import math
from collections.abc import Callable, Mapping

import numpy as np

from benchmarks.numerics.cases.case import Case, Reading, refused
from nvsf_core.errors import ShapeError
from nvsf_core.metrics.depth import ray_depth_rmse
from nvsf_core.metrics.elementwise import PSNR_CAP_DB, median_abs_error, psnr, rmse
from nvsf_core.metrics.hit import hit_cell_metrics, hit_image_metrics
from nvsf_core.metrics.image import image_metrics
from nvsf_core.metrics.lpips import MIN_SIDE, load_lpips, lpips_measure
from nvsf_core.metrics.measure import Measure
from nvsf_core.metrics.range_and_intensity import (
    intensity_image_metrics,
    range_image_metrics,
    ray_range_metrics,
)
from nvsf_core.metrics.ssim import ssim

TITLE = "Metrics"


def _plain_ssim(p: np.ndarray, t: np.ndarray, data_range: float) -> float:
    """Window by window, about each window's own mean, in extended precision."""
    c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
    values = []
    for row in range(p.shape[0] - 6):
        for column in range(p.shape[1] - 6):
            a, b = (x[row : row + 7, column : column + 7].astype(np.longdouble) for x in (p, t))
            ma, mb = a.mean(), b.mean()
            va, vb = ((a - ma) ** 2).sum() / 48, ((b - mb) ** 2).sum() / 48
            cov = ((a - ma) * (b - mb)).sum() / 48
            values.append((2 * ma * mb + c1) * (2 * cov + c2) / ((ma**2 + mb**2 + c1) * (va + vb + c2)))
    return float(np.mean(values))


def _ssim(level: float, contrast: float) -> Reading:
    """Images of a mean level and a contrast, against window-by-window sums in extended precision."""
    rng = np.random.default_rng(0)
    truth = level + contrast * rng.random((20, 24))
    predicted = truth + 0.1 * contrast * rng.normal(size=truth.shape)
    data_range = float(np.ptp(truth))
    found = ssim(predicted, truth, data_range)
    error = abs(found.value - _plain_ssim(predicted, truth, data_range))
    # Rounding the images themselves costs (level / contrast) of their last digits.
    limit = 1e-9 + 50.0 * np.finfo(np.float64).eps * (level / contrast) ** 2
    return Reading(error=error, limit=limit, is_refuted=not -1.0 <= found.value <= 1.0)


def _ssim_range() -> Reading:
    """Nearly constant images: within [-1, 1] all the same, as stated."""
    rng = np.random.default_rng(1)
    values = []
    for noise in (1e-17, 1e-16, 1e-15, 1e-12, 1e-9):
        for level in (0.3, 80.0):
            truth = level + noise * rng.normal(size=(30, 30)) * level
            if np.ptp(truth) == 0.0:
                continue
            predicted = level + noise * rng.normal(size=(30, 30)) * level
            values.append(ssim(predicted, truth, float(np.ptp(truth))).value)
    inside = all(-1.0 <= value <= 1.0 for value in values)
    return Reading(outcome=f"{min(values):.3g} to {max(values):.3g}", is_refuted=not inside)


def _ssim_ends() -> Reading:
    rng = np.random.default_rng(2)
    image = rng.random((20, 20))
    same, negative = ssim(image, image, 1.0).value, ssim(1.0 - image, image, 1.0).value
    return Reading(error=abs(same - 1.0), limit=1e-15, outcome=f"itself {same}, its negative {negative:.2f}",
                   is_refuted=not -1.0 <= negative < 0.0)  # fmt: skip


def _psnr() -> Reading:
    """Mean squared errors from 1e-20 to 1e4 of the squared peak, against the definition."""
    worst = 0.0
    for error in (0.0, 1e-12, 1e-5, 1e-4, 1e-3, 0.5, 1.0, 100.0):
        truth = np.full((5, 5), 3.0)
        found = psnr(truth + 80.0 * error, truth, 80.0).value
        exact = PSNR_CAP_DB if error <= 1e-4 else -20.0 * math.log10(error)
        worst = max(worst, abs(found - exact))
    return Reading(error=worst, limit=1e-6, unit="dB", outcome=f"capped at {PSNR_CAP_DB:g} dB")


def _single_precision() -> Reading:
    """float32 panos with errors of 1 mm at 80 m, and with values up to 3e38: no overflow, no lost digits."""
    truth = np.full((66, 1030), 79.0, np.float32)
    found = rmse(truth + np.float32(2**-10), truth).value
    huge = rmse(np.full(4, 3e38, np.float32), np.full(4, -3e38, np.float32)).value
    error = max(abs(found - 2**-10) / 2**-10, abs(huge - 6e38) / 6e38)
    return Reading(error=error, limit=1e-6, unit="relative", float32="ok")


def _told(run: Callable[[], Mapping[str, Measure]], *undefined: str) -> Reading:
    """These are NaN with a reason; everything else is a number."""
    found = run()
    wrong = [
        name for name, measure in found.items()
        if (name in undefined or "all" in undefined) != (math.isnan(measure.value) and bool(measure.reason))
        and not measure.is_absent
    ]  # fmt: skip
    told = "; ".join(dict.fromkeys(m.reason for m in found.values() if m.reason and not m.is_absent))
    return Reading(outcome=told or "all defined", is_refuted=bool(wrong))


def _image(size: int, valid: bool, level: float | None = None) -> Callable[[], Mapping[str, Measure]]:
    def run() -> Mapping[str, Measure]:
        rng = np.random.default_rng(0)
        truth = rng.integers(0, 256, (size, size, 3)).astype(np.uint8)
        if level is not None:
            truth[:] = level
        return image_metrics(truth.copy(), truth, np.full((size, size), valid), load_lpips())

    return run


def _constant_pano() -> Mapping[str, Measure]:
    return range_image_metrics(np.full((20, 20), 5.0), np.full((20, 20), 5.0))


def _lpips() -> Reading:
    """The network's own limits: identical, constant, black images; one too small; NaN."""
    network = load_lpips()
    if network is None:
        return Reading(outcome="not run: no LPIPS weights on this machine")
    rng = np.random.default_rng(0)
    image = rng.random((64, 64, 3))
    flat, black = np.full((64, 64, 3), 0.5), np.zeros((64, 64, 3))
    same, dark = (lpips_measure(network, x, x.copy()).value for x in (image, black))
    apart = lpips_measure(network, flat, black).value
    small = lpips_measure(network, image[: MIN_SIDE - 1], image[: MIN_SIDE - 1])
    broken = lpips_measure(network, np.full((64, 64), math.nan), np.zeros((64, 64)))
    sound = bool(small.reason) and bool(broken.reason) and math.isfinite(apart) and apart > 0.0
    return Reading(error=max(abs(same), abs(dark)), limit=1e-6, outcome=f"{small.reason}; {broken.reason}",
                   float32="ok", is_refuted=not sound)  # fmt: skip


def _hits(predicted: float, truth: bool) -> Callable[[], Mapping[str, Measure]]:
    return lambda: hit_image_metrics(np.full((4, 5), predicted), np.full((4, 5), truth))


def _cells(points: float, laser: int) -> Callable[[], Mapping[str, Measure]]:
    """A return like these, against one of laser 0."""
    cloud = np.full((3, 3), points)
    return lambda: hit_cell_metrics(cloud, np.zeros(3, int), cloud.copy(), np.full(3, laser), 4)


def _rays(predicted: float) -> Callable[[], Mapping[str, Measure]]:
    return lambda: ray_range_metrics(np.full(10, predicted), np.full(10, 7.0))


_NOTHING = np.zeros((0,))
_ONE_RANGE = np.array([[5.0]])
_HIT = ("hit_accuracy", "hit_f_score")
CASES = (
    Case("metrics.ssim.ssim", "level 0.5, contrast 1", lambda: _ssim(0.5, 1.0)),
    Case("metrics.ssim.ssim", "level 80 m, contrast 1 mm", lambda: _ssim(80.0, 1e-3)),
    Case("metrics.ssim.ssim", "contrast 1e-17 to 1e-9 of the level", _ssim_range),
    Case("metrics.ssim.ssim", "an image against itself and its negative", _ssim_ends),
    Case("metrics.elementwise.psnr", "errors 0 to 100 times the peak", _psnr),
    Case("metrics.elementwise.rmse", "float32: 1 mm at 79 m, ±3e38", _single_precision),
    Case("metrics.range.range_image_metrics", "constant pano", lambda: _told(_constant_pano, "range_ssim")),
    Case(
        "metrics.range.range_image_metrics", "one pixel",
        lambda: _told(lambda: range_image_metrics(_ONE_RANGE, _ONE_RANGE), "range_ssim"),
    ),
    Case(
        "metrics.range.range_image_metrics", "a NaN pixel",
        lambda: _told(lambda: range_image_metrics(_ONE_RANGE * math.nan, _ONE_RANGE), "all"),
    ),
    Case(
        "metrics.intensity.intensity_image_metrics", "intensities all 0",
        lambda: _told(lambda: intensity_image_metrics(np.zeros((9, 9)), np.zeros((9, 9))), "intensity_ssim"),
    ),
    Case("metrics.range.ray_range_metrics", "no answer: infinitely wrong", lambda: _told(_rays(math.inf))),
    Case("metrics.range.ray_range_metrics", "NaN answers", lambda: _told(_rays(math.nan), "all")),
    Case(
        "metrics.range.ray_range_metrics", "no ray",
        lambda: _told(lambda: ray_range_metrics(_NOTHING, _NOTHING), "all"),
    ),
    Case("metrics.image.image_metrics", "no valid pixel", lambda: _told(_image(40, False), "all")),
    Case(
        "metrics.image.image_metrics", "one pixel",
        lambda: _told(_image(1, True), "image_ssim", "image_lpips_squeeze"),
    ),
    Case("metrics.image.image_metrics", "constant images", lambda: _told(_image(40, True, 128.0))),
    Case("metrics.lpips.lpips_measure", "identical, constant, black, 31 pixels, NaN", _lpips),
    Case("metrics.hit.hit_image_metrics", "no return at all", lambda: _told(_hits(0.0, False), _HIT[1])),
    Case("metrics.hit.hit_image_metrics", "all hit", lambda: _told(_hits(1.0, True))),
    Case("metrics.hit.hit_image_metrics", "NaN", lambda: _told(_hits(math.nan, True), "all")),
    Case("metrics.hit.hit_cell_metrics", "NaN points", lambda: _told(_cells(math.nan, 0), *_HIT)),
    Case("metrics.hit.hit_cell_metrics", "unknown lasers", lambda: _told(_cells(1.0, -1), *_HIT)),
    Case("metrics.hit.hit_cell_metrics", "a laser too many", lambda: _told(_cells(1.0, 9), *_HIT)),
    Case(
        "metrics.depth.ray_depth_rmse", "no return in the image",
        lambda: _told(lambda: {"rmse": ray_depth_rmse(np.zeros((2, 2)), np.zeros((2, 2)))}, "all"),
    ),
    Case(
        "metrics.elementwise.median_abs_error", "nothing",
        lambda: _told(lambda: {"medae": median_abs_error(_NOTHING, _NOTHING)}, "all"),
    ),
    Case(
        "metrics.elementwise.psnr", "peak 0 (outside)",
        lambda: refused(ValueError, lambda: psnr(np.ones(3), np.zeros(3), 0.0)),
    ),
    Case(
        "metrics.elementwise.rmse", "shapes that broadcast (outside)",
        lambda: refused(ShapeError, lambda: rmse(np.zeros((3, 1)), np.zeros(3))),
    ),
)  # fmt: skip
