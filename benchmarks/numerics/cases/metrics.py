"""Clouds far out, empty and identical; metrics of empty masks, constant images, one pixel, NaN."""

import math
from collections.abc import Callable, Mapping

import numpy as np
import torch
from torch import Tensor

from benchmarks.numerics.cases.case import Case, Reading, largest, refused
from benchmarks.numerics.cases.references import against, by_autograd
from benchmarks.numerics.cases.tolerances import SUM_EPS
from nvsf_core.errors import DivergedError
from nvsf_core.losses.chamfer import (
    chamfer_distance,
    nearest_by_all_pairs,
    ray_batch_chamfer,
    scene_flow_loss,
)
from nvsf_core.metrics.depth import ray_depth_rmse
from nvsf_core.metrics.elementwise import PSNR_CAP_DB, median_abs_error, psnr, rmse
from nvsf_core.metrics.hit import hit_cell_metrics, hit_image_metrics
from nvsf_core.metrics.image import image_metrics
from nvsf_core.metrics.lpips import MIN_SIDE, load_lpips, lpips_measure
from nvsf_core.metrics.measure import Measure
from nvsf_core.metrics.point_cloud import point_cloud_metrics
from nvsf_core.metrics.range_and_intensity import (
    intensity_image_metrics,
    range_image_metrics,
    ray_range_metrics,
)
from nvsf_core.metrics.ssim import ssim

TITLE = "Point clouds and metrics"
_CLOUDS = [torch.rand(n, 3, generator=torch.Generator().manual_seed(n)).numpy() * 20.0 for n in (300, 350)]


def _plain_ssim(p: np.ndarray, t: np.ndarray, data_range: float) -> float:
    """Window by window, about each window's own mean, in extended precision."""
    c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
    values = []
    for row, column in np.ndindex(p.shape[0] - 6, p.shape[1] - 6):
        a, b = (x[row : row + 7, column : column + 7].astype(np.longdouble) for x in (p, t))
        ma, mb = a.mean(), b.mean()
        va, vb = ((a - ma) ** 2).sum() / 48, ((b - mb) ** 2).sum() / 48
        cov = ((a - ma) * (b - mb)).sum() / 48
        values.append((2 * ma * mb + c1) * (2 * cov + c2) / ((ma**2 + mb**2 + c1) * (va + vb + c2)))
    return float(np.mean(values))


def _ssim(level: float, contrast: float) -> float:
    rng = np.random.default_rng(0)
    truth = level + contrast * rng.random((20, 24))
    predicted = truth + 0.1 * contrast * rng.normal(size=truth.shape)
    data_range = float(np.ptp(truth))
    return abs(ssim(predicted, truth, data_range).value - _plain_ssim(predicted, truth, data_range))


def _ssim_of_noise() -> str:
    rng, values = np.random.default_rng(1), []
    for noise in (1e-17, 1e-16, 1e-15, 1e-12, 1e-9):
        for level in (0.3, 80.0):
            truth, predicted = level * (1.0 + noise * rng.normal(size=(2, 30, 30)))
            if np.ptp(truth) > 0.0:
                values.append(ssim(predicted, truth, float(np.ptp(truth))).value)
    assert all(-1.0 <= value <= 1.0 for value in values), f"{values}"
    return f"{min(values):.3g} to {max(values):.3g}"


def _ssim_ends() -> Reading:
    image = np.random.default_rng(2).random((20, 20))
    same, negative = (ssim(x, image, 1.0).value for x in (image, 1.0 - image))
    assert -1.0 <= negative < 0.0, f"{negative}"
    return Reading(error=abs(same - 1.0), outcome=f"itself {same}, its negative {negative:.2f}")


def _psnr() -> float:
    worst, truth = 0.0, np.full((5, 5), 3.0)
    for error in (0.0, 1e-12, 1e-5, 1e-4, 1e-3, 0.5, 1.0, 100.0):
        exact = PSNR_CAP_DB if error <= 1e-4 else -20.0 * math.log10(error)
        worst = max(worst, abs(psnr(truth + 80.0 * error, truth, 80.0).value - exact))
    return worst


def _single_precision() -> float:
    truth, huge = np.full((66, 1030), 79.0, np.float32), np.full(4, 3e38, np.float32)
    fine, coarse = rmse(truth + np.float32(2**-10), truth).value, rmse(huge, -huge).value
    return max(abs(fine / 2**-10 - 1.0), abs(coarse / 6e38 - 1.0))


def _lpips() -> Reading:
    network = load_lpips()
    if network is None:
        return Reading(outcome="not run: no LPIPS weights on this machine")
    image, black = np.random.default_rng(0).random((64, 64, 3)), np.zeros((64, 64, 3))
    apart = lpips_measure(network, np.full((64, 64, 3), 0.5), black).value
    small = lpips_measure(network, image[: MIN_SIDE - 1], image[: MIN_SIDE - 1]).reason
    broken = lpips_measure(network, np.full((64, 64), math.nan), np.zeros((64, 64))).reason
    assert small and broken and 0.0 < apart < math.inf, f"{small}, {broken}, {apart}"
    same = max(abs(lpips_measure(network, x, x.copy()).value) for x in (image, black))
    return Reading(error=same, outcome=f"{small}; {broken}")


def _told(
    function: str, inputs: str, run: Callable[[], Mapping[str, Measure] | Measure], *undefined: str
) -> Case:
    """A case in which these metrics, or all, are NaN with a reason and every other one is a number."""

    def check() -> str:
        measured = run()
        found = {"all": measured} if isinstance(measured, Measure) else measured
        for name, measure in found.items():
            is_told = math.isnan(measure.value) and bool(measure.reason)
            assert measure.is_absent or is_told == (undefined == ("all",) or name in undefined), f"{measure}"
        reasons = dict.fromkeys(m.reason for m in found.values() if m.reason and not m.is_absent)
        return "; ".join(reasons) or "all defined"

    return Case(f"metrics.{function}", inputs, check)


def _image(size: int, valid: bool, level: int | None = None) -> Mapping[str, Measure]:
    truth = np.random.default_rng(0).integers(0, 256, (size, size, 3)).astype(np.uint8)
    truth = truth if level is None else np.full_like(truth, level)
    return image_metrics(truth.copy(), truth, np.full((size, size), valid), load_lpips())


def _hits(predicted: float, truth: bool) -> Mapping[str, Measure]:
    return hit_image_metrics(np.full((4, 5), predicted), np.full((4, 5), truth))


def _cells(points: float, laser: int) -> Mapping[str, Measure]:
    cloud = np.full((3, 3), points)
    return hit_cell_metrics((cloud, np.zeros(3, int)), (cloud.copy(), np.full(3, laser)), (4, 2000))


def _rays(predicted: float) -> Mapping[str, Measure]:
    return ray_range_metrics(np.full(10, predicted), np.full(10, 7.0))


def _all_pairs_chamfer(points: Tensor, others: Tensor) -> Tensor:
    squared = ((points[:, None] - others[None]) ** 2).sum(dim=2)
    return squared.min(dim=1).values.mean() + squared.min(dim=0).values.mean()


def _chamfer(shift_m: float, has_gradient: bool) -> Reading:
    clouds, slope_scale = [cloud + np.float64(shift_m) for cloud in _CLOUDS], 0.01 if has_gradient else None
    return against(chamfer_distance, by_autograd(_all_pairs_chamfer), clouds, gradient_scale=slope_scale)


def _all_pairs() -> float:
    """The form for CUDA: how much farther the chosen one is than the nearest."""
    worst = 0.0
    for shift_m in (0.0, 3800.0):
        points, others = (torch.from_numpy(cloud + np.float32(shift_m)) for cloud in _CLOUDS)
        distance = (points.double()[:, None] - others.double()[None]).norm(dim=2)
        chosen = distance.gather(1, nearest_by_all_pairs(points, others)[:, None])[:, 0]
        worst = max(worst, largest(chosen, distance.min(dim=1).values))
    return worst


def _identical() -> Reading:
    worst, slope = 0.0, 0.0
    for count in (300, 1):
        cloud = torch.from_numpy(_CLOUDS[0][:count] + np.float32(1e4)).requires_grad_()
        value = chamfer_distance(cloud, cloud.detach().clone())
        slope = max(slope, largest(*torch.autograd.grad(value, cloud), 0.0))
        worst = max(worst, value.item())
    return Reading(error=worst, gradient=slope, gradient_limit=0.0)


def _no_return() -> Reading:
    direction = torch.nn.functional.normalize(torch.from_numpy(_CLOUDS[0][:64] - 10.0), dim=1)
    rendered = torch.full((64,), 17.0, requires_grad=True)
    loss = ray_batch_chamfer(direction, rendered, torch.zeros(64))
    slope = largest(*torch.autograd.grad(loss.sum(), rendered), 0.0)
    return Reading(error=loss.max().item(), gradient=slope, gradient_limit=0.0)


def _no_neighbour() -> str:
    """No neighbour, no points: an empty term, which the total counts as absent."""
    cloud, none = torch.from_numpy(_CLOUDS[0]), torch.zeros(0, 3)
    rest = torch.zeros_like(cloud)
    given = ((cloud, None, None), (none, cloud, cloud), (cloud, none, None), (cloud, none, cloud))
    found = [scene_flow_loss(c, rest[: len(c)], rest[: len(c)], *others).tolist() for c, *others in given]
    assert found == [[], [], [], [0.0]], f"{found}"
    return f"terms {found}"


def _far_metrics() -> float:
    shift = np.array([5e6, -5e6, 5e6])
    near, far = (point_cloud_metrics(*(c.astype(np.float64) + s for c in _CLOUDS)) for s in (0.0, shift))
    return abs(near["chamfer_m2"].value - far["chamfer_m2"].value)


def _lattice() -> float:
    """A lattice of a metre and itself moved by 0.1 m: each point's nearest is its own image."""
    lattice = np.stack(np.meshgrid(*[np.arange(100.0)] * 3), axis=-1).reshape(-1, 3)
    found = point_cloud_metrics(lattice + np.array([0.1, 0.0, 0.0]), lattice)
    return abs(found["chamfer_m2"].value - 0.02)


def _measured(inputs: str, predicted: np.ndarray, truth: np.ndarray, *expected: float) -> Case:
    """Chamfer distance and F-score; expected NaN has to come with a reason."""

    def check() -> str:
        found = point_cloud_metrics(predicted, truth)
        for measure, value in zip((found["chamfer_m2"], found["f_score"]), expected, strict=True):
            is_right = math.isclose(measure.value, value, rel_tol=1e-9, abs_tol=1e-9)
            assert is_right or (math.isnan(value) and math.isnan(measure.value) and measure.reason), (
                f"{found}"
            )
        return f"{ {name: measure.reason or measure.value for name, measure in found.items()} }"

    return Case(_CLOUD, inputs, check)


_POINT, _NONE, _NAN = np.array([[1.0, 2.0, 3.0]]), np.zeros((0, 3)), math.nan
_LOSS, _CLOUD = "losses.chamfer.chamfer_distance", "metrics.point_cloud.point_cloud_metrics"
_NOTHING, _ONE, _FLAT, _BLACK = np.zeros((0,)), np.array([[5.0]]), np.full((20, 20), 5.0), np.zeros((9, 9))
_IMAGE = "image.image_metrics"
_RANGE, _RAYS = (f"range_and_intensity.{name}_metrics" for name in ("range_image", "ray_range"))
_HITS, _CELLS, _HIT = "hit.hit_image_metrics", "hit.hit_cell_metrics", ("hit_accuracy", "hit_f_score")
CASES = (
    Case(_LOSS, "300 and 350 points at the origin", lambda: _chamfer(0.0, True), SUM_EPS, "ulp"),
    Case(_LOSS, "the same 3.8 km out", lambda: _chamfer(3800.0, True), SUM_EPS, "ulp"),
    # There many are equally near, and the slope towards any of them is right.
    Case(_LOSS, "the same 1e6 m out, where float32 knows 6 cm", lambda: _chamfer(1e6, False), SUM_EPS, "ulp"),
    Case(_LOSS, "identical clouds, 1e4 m out; one point and itself", _identical, 0.0, "m²"),
    Case(_LOSS, "NaN (outside)",
         refused(DivergedError, lambda: chamfer_distance(torch.full((2, 3), _NAN), torch.zeros(1, 3)))),
    Case("losses.chamfer.nearest_by_all_pairs", "at the origin and 3.8 km out", _all_pairs, 1e-5,
         "m farther than the nearest"),
    Case("losses.chamfer.ray_batch_chamfer", "64 rays, no return", _no_return, 0.0, "m²"),
    Case("losses.chamfer.scene_flow_loss", "no neighbour, empty clouds, one neighbour", _no_neighbour),
    Case(_CLOUD, "two clouds at 0 and 5e6 m out", _far_metrics, 1e-8, "m²"),
    Case(_CLOUD, "1e6 points against 1e6", _lattice, 1e-12, "m²"),
    _measured("identical", _POINT, _POINT, 0.0, 1.0),
    _measured("one point against one 0.1 m away", _POINT, _POINT + np.array([0.0, 0.0, 0.1]), 0.02, 1.0),
    _measured("predicted empty", _NONE, _POINT, _NAN, 0.0),
    _measured("truth empty", _POINT, _NONE, _NAN, 0.0),
    _measured("both empty", _NONE, _NONE, _NAN, _NAN),
    _measured("a NaN among the points", _POINT * _NAN, _POINT, _NAN, _NAN),
    _measured("1e15 m apart: huge, finite", _POINT, _POINT + np.array([1e15, 0.0, 0.0]), 2e30, 0.0),
    Case("metrics.ssim.ssim", "level 0.5, contrast 1", lambda: _ssim(0.5, 1.0), 1e-9),
    # Rounding the images themselves costs (level / contrast) squared of their last digits.
    Case("metrics.ssim.ssim", "level 80 m, contrast 1 mm", lambda: _ssim(80.0, 1e-3), 7.1e-5),
    Case("metrics.ssim.ssim", "contrast 1e-17 to 1e-9 of the level", _ssim_of_noise),
    Case("metrics.ssim.ssim", "an image with itself and with its negative", _ssim_ends, 1e-15),
    Case("metrics.elementwise.psnr", "errors 0 to 100 times the peak", _psnr, 1e-6, "dB"),
    Case("metrics.elementwise.psnr", "peak 0 (outside)",
         refused(ValueError, lambda: psnr(np.ones(3), np.zeros(3), 0.0))),
    Case("metrics.elementwise.rmse", "float32: 1 mm at 79 m, ±3e38", _single_precision, 1e-6),
    Case("metrics.lpips.lpips_measure", "identical, constant, black, 31 pixels, NaN", _lpips, 1e-6),
    _told("elementwise.median_abs_error", "nothing", lambda: median_abs_error(_NOTHING, _NOTHING), "all"),
    _told("depth.ray_depth_rmse", "no return in the image", lambda: ray_depth_rmse(_BLACK, _BLACK), "all"),
    _told(_RANGE, "constant pano", lambda: range_image_metrics(_FLAT, _FLAT), "range_ssim"),
    _told(_RANGE, "one pixel", lambda: range_image_metrics(_ONE, _ONE), "range_ssim"),
    _told(_RANGE, "a NaN pixel", lambda: range_image_metrics(_ONE * math.nan, _ONE), "all"),
    _told("range_and_intensity.intensity_image_metrics", "intensities all 0",
          lambda: intensity_image_metrics(_BLACK, _BLACK), "intensity_ssim"),
    _told(_RAYS, "no answer: infinitely wrong", lambda: _rays(math.inf)),
    _told(_RAYS, "NaN ranges", lambda: _rays(math.nan), "all"),
    _told(_RAYS, "no ray", lambda: ray_range_metrics(_NOTHING, _NOTHING), "all"),
    _told(_IMAGE, "no valid pixel", lambda: _image(40, False), "all"),
    _told(_IMAGE, "one pixel", lambda: _image(1, True), "image_ssim", "image_lpips_squeeze"),
    _told(_IMAGE, "constant images", lambda: _image(40, True, 128)),
    _told(_HITS, "no return at all", lambda: _hits(0.0, False), "hit_f_score"),
    _told(_HITS, "all hit", lambda: _hits(1.0, True)),
    _told(_HITS, "NaN", lambda: _hits(math.nan, True), "all"),
    _told(_CELLS, "NaN points", lambda: _cells(math.nan, 0), *_HIT),
    _told(_CELLS, "unknown lasers", lambda: _cells(1.0, -1), *_HIT),
    _told(_CELLS, "a laser too many", lambda: _cells(1.0, 9), *_HIT),
)  # fmt: skip
