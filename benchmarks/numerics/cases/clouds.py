"""Squared Chamfer distance: far out, empty, single, identical; F-scores; scene flow."""

import math
from collections.abc import Mapping

import numpy as np
import torch

from benchmarks.numerics.cases.case import NOT_ON_GPU, Case, Gradient, Reading, refused
from benchmarks.numerics.cases.tolerances import TOLERANCES
from nvsf_core.errors import DivergedError, ShapeError
from nvsf_core.losses.chamfer import chamfer_distance, nearest_by_all_pairs, ray_batch_chamfer
from nvsf_core.losses.scene_flow import scene_flow_loss
from nvsf_core.metrics.measure import Measure
from nvsf_core.metrics.point_cloud import point_cloud_metrics

TITLE = "Point clouds"


def _clouds(shift: float, count: int = 300) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    clouds = [torch.rand(n, 3, generator=generator) * 20.0 + shift for n in (count, count + 50)]
    return clouds[0], clouds[1]


def _plain(points: torch.Tensor, others: torch.Tensor) -> torch.Tensor:
    """All pairs in float64, differentiable."""
    squared = ((points[:, None] - others[None]) ** 2).sum(dim=2)
    return squared.min(dim=1).values.mean() + squared.min(dim=0).values.mean()


def _chamfer(shift: float) -> Reading:
    """Loss and gradient against all pairs in float64 of the same float32 points."""
    found, exact = (
        [c.to(t).requires_grad_() for c in _clouds(shift)] for t in (torch.float32, torch.float64)
    )
    value, true = chamfer_distance(*found), _plain(*exact)
    value.backward()
    true.backward()
    right, eps = float(true.detach()), torch.finfo(torch.float32).eps
    error = abs(float(value.detach()) - right) / right / eps
    worst, finite = 0.0, True
    for single, double in zip(found, exact, strict=True):
        assert single.grad is not None and double.grad is not None
        finite &= bool(single.grad.isfinite().all())
        worst = max(worst, float((single.grad.double() - double.grad).abs().max() / double.grad.abs().max()))
    return Reading(
        error=error, limit=TOLERANCES[torch.float32].sum_eps, unit="ulp", float32="ok", cuda=NOT_ON_GPU,
        # On the 6 cm lattice of float32 many are equally near, and any of them is right.
        gradient=Gradient(finite, worst if shift < 1e6 else 0.0, TOLERANCES[torch.float32].gradient),
    )  # fmt: skip


def _all_pairs(shift: float) -> Reading:
    """The form for CUDA picks the same neighbours as the tree."""
    points, others = _clouds(shift)
    index = nearest_by_all_pairs(points, others)
    exact = (points.double()[:, None] - others.double()[None]).norm(dim=2)
    beyond = exact.gather(1, index[:, None])[:, 0] - exact.min(dim=1).values
    return Reading(
        error=float(beyond.max()), limit=1e-5 + 2e-7 * shift, unit="m farther than the nearest", float32="ok"
    )


def _identical(count: int) -> Reading:
    """A cloud and itself: exactly 0, gradient exactly 0 and not NaN."""
    cloud = _clouds(1e4, count)[0].requires_grad_()
    value = chamfer_distance(cloud, cloud.detach().clone())
    value.backward()
    assert cloud.grad is not None
    slope = Gradient(bool(cloud.grad.isfinite().all()), float(cloud.grad.abs().max()), 0.0)
    return Reading(error=float(value.detach()), limit=0.0, unit="m²", gradient=slope, float32="ok")


def _metrics(predicted: np.ndarray, truth: np.ndarray, chamfer: float, f_score: float) -> Reading:
    """Values, NaN with a reason where there is none."""
    found = point_cloud_metrics(predicted, truth)
    wrong = [name for name, expected in (("chamfer_m2", chamfer), ("f_score", f_score))
             if not _is(found[name], expected)]  # fmt: skip
    told = {name: found[name].reason or found[name].value for name in found}
    return Reading(outcome=f"{told}", is_refuted=bool(wrong))


def _is(measure: Measure, expected: float) -> bool:
    if math.isnan(expected):
        return math.isnan(measure.value) and bool(measure.reason)
    return math.isclose(measure.value, expected, rel_tol=1e-9, abs_tol=1e-9)


def _far_metrics() -> Reading:
    """The same two clouds at the origin and 5e6 m out."""
    near = [c.double().numpy() for c in _clouds(0.0)]
    far = [c + np.array([5e6, -5e6, 5e6]) for c in near]
    sides: list[Mapping[str, Measure]] = [point_cloud_metrics(*near), point_cloud_metrics(*far)]
    error = abs(sides[0]["chamfer_m2"].value - sides[1]["chamfer_m2"].value)
    return Reading(error=error, limit=1e-8, unit="m²")


def _rays() -> Reading:
    """A batch in which nothing returned: 0, with gradients of 0."""
    direction = torch.nn.functional.normalize(
        torch.randn(64, 3, generator=torch.Generator().manual_seed(0)), dim=1
    )
    rendered = torch.full((64,), 17.0, requires_grad=True)
    loss = ray_batch_chamfer(direction, rendered, torch.zeros(64))
    loss.sum().backward()
    assert rendered.grad is not None
    slope = Gradient(bool(rendered.grad.isfinite().all()), float(rendered.grad.abs().max()), 0.0)
    return Reading(error=float(loss.detach().max()), limit=0.0, unit="m²", gradient=slope, float32="ok")


def _no_flow() -> Reading:
    """No neighbours, no points: an empty term, which the total counts as absent."""
    empty, cloud = torch.zeros(0, 3), torch.rand(5, 3, generator=torch.Generator().manual_seed(0))
    zero = torch.zeros(5, 3)
    lengths = [
        len(scene_flow_loss(cloud, zero, zero, None, None)),
        len(scene_flow_loss(empty, empty, empty, cloud, cloud)),
        len(scene_flow_loss(cloud, zero, zero, empty, cloud)),
    ]  # fmt: skip
    return Reading(outcome=f"terms {lengths}", float32="ok", is_refuted=lengths != [0, 0, 1])


_ONE, _NONE = np.array([[1.0, 2.0, 3.0]]), np.zeros((0, 3))
_NEXT = _ONE + np.array([[0.0, 0.0, 0.1]])
_FAR = _ONE + np.array([[1e15, 0.0, 0.0]])
_METRICS, _LOSS = "metrics.point_cloud.point_cloud_metrics", "losses.chamfer.chamfer_distance"
_NAN = math.nan
CASES = (
    Case(_LOSS, "300 and 350 points at the origin", lambda: _chamfer(0.0)),
    Case(_LOSS, "the same 3.8 km out", lambda: _chamfer(3800.0)),
    Case(_LOSS, "the same 1e6 m out, where float32 knows 6 cm", lambda: _chamfer(1e6)),
    Case(_LOSS, "identical clouds, 1e4 m out", lambda: _identical(300)),
    Case(_LOSS, "one point and itself", lambda: _identical(1)),
    Case("losses.chamfer.nearest_by_all_pairs", "at the origin", lambda: _all_pairs(0.0)),
    Case("losses.chamfer.nearest_by_all_pairs", "3.8 km out", lambda: _all_pairs(3800.0)),
    Case("losses.chamfer.ray_batch_chamfer", "64 rays, no return", _rays),
    Case("losses.scene_flow.scene_flow_loss", "no neighbours, empty clouds", _no_flow),
    Case(_METRICS, "two clouds at 0 and 5e6 m out", _far_metrics),
    Case(_METRICS, "identical", lambda: _metrics(_ONE, _ONE, 0.0, 1.0)),
    Case(_METRICS, "one point against one 0.1 m away", lambda: _metrics(_ONE, _NEXT, 0.02, 1.0)),
    Case(_METRICS, "predicted empty", lambda: _metrics(_NONE, _ONE, _NAN, 0.0)),
    Case(_METRICS, "truth empty", lambda: _metrics(_ONE, _NONE, _NAN, 0.0)),
    Case(_METRICS, "both empty", lambda: _metrics(_NONE, _NONE, _NAN, _NAN)),
    Case(_METRICS, "a NaN among the points", lambda: _metrics(_ONE * _NAN, _ONE, _NAN, _NAN)),
    Case(_METRICS, "1e15 m apart: huge, finite", lambda: _metrics(_ONE, _FAR, 2e30, 0.0)),
    Case(
        _LOSS, "an empty cloud (outside)",
        lambda: refused(ShapeError, lambda: chamfer_distance(torch.zeros(0, 3), torch.zeros(1, 3))),
    ),
    Case(
        _LOSS, "NaN (outside)",
        lambda: refused(DivergedError, lambda: chamfer_distance(torch.full((2, 3), _NAN), torch.zeros(1, 3))),
    ),
)  # fmt: skip
