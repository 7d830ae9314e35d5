"""Laws of the guarded operations and of compositing, over generated inputs of their whole domains."""

import math
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.numerics.cases.tolerances import ELEMENTWISE_ULP, EPS, SUM_EPS
from nvsf_core import numerics
from nvsf_core.evidence.surfels import weighted_median_index
from nvsf_core.losses.lidar import CLAMP_M, depth_loss
from nvsf_core.rendering.volume import uniform_samples, weights_from_optical_depth

LAW = settings(derandomize=True, deadline=None, max_examples=40, database=None)
UNARY = {
    "safe_exp": numerics.safe_exp,
    "probability_logit": partial(numerics.probability_logit, margin=0.003),
}
TYPES = (torch.float64, torch.float32)
any_float = st.floats(width=32, allow_nan=False, allow_infinity=False)
depths = st.lists(st.floats(0.0, 2.0**127, width=32), min_size=1, max_size=40)


def _tensor(values: list[float], dtype: torch.dtype = torch.float32) -> torch.Tensor:
    largest = torch.finfo(dtype).max
    return torch.tensor(values, dtype=torch.float64).clamp(-largest, largest).to(dtype)


@pytest.mark.parametrize("dtype", TYPES, ids=str)
@pytest.mark.parametrize("name", UNARY)
@LAW
@given(st.lists(any_float, min_size=1, max_size=30))
def test_values_and_gradients_are_finite(name: str, dtype: torch.dtype, values: list[float]) -> None:
    x = _tensor(values, dtype).requires_grad_()
    y = UNARY[name](x)
    y.sum().backward()
    assert y.dtype is dtype and x.grad is not None
    assert torch.isfinite(y).all() and torch.isfinite(x.grad).all()


@pytest.mark.parametrize("name", UNARY)
@LAW
@given(any_float, any_float)
def test_all_of_them_ascend(name: str, a: float, b: float) -> None:
    low, high = UNARY[name](_tensor([min(a, b), max(a, b)]).double())
    assert low <= high + ELEMENTWISE_ULP * 2.0**-52 * abs(high)


@LAW
@given(st.floats(0.0, 1.0))
def test_the_logit_is_odd_about_a_half(p: float) -> None:
    one, other = numerics.probability_logit(_tensor([p, 1.0 - p], torch.float64), 0.003)
    assert one.item() == pytest.approx(-other.item(), abs=1e-9)


@pytest.mark.parametrize("dtype", TYPES, ids=str)
@LAW
@given(depths)
def test_weights_are_shares_of_one(dtype: torch.dtype, values: list[float]) -> None:
    depth = _tensor(values, dtype)[None]
    weights, after = weights_from_optical_depth(depth)
    assert ((weights >= 0.0) & (weights <= 1.0)).all()
    total = (weights.double().sum() + after.double()).item()
    assert abs(total - 1.0) <= SUM_EPS * torch.finfo(dtype).eps


@LAW
@given(depths, st.integers(0, 39))
def test_an_interval_of_length_zero_changes_nothing(values: list[float], place: int) -> None:
    place = min(place, len(values))
    weights, after = weights_from_optical_depth(_tensor(values)[None])
    more, same = weights_from_optical_depth(_tensor([*values[:place], 0.0, *values[place:]])[None])
    assert more[0, place] == 0.0 and (after - same).abs().max() <= ELEMENTWISE_ULP * EPS
    kept = torch.cat([more[:, :place], more[:, place + 1 :]], dim=1)
    assert (kept - weights).abs().max() <= SUM_EPS * EPS


@LAW
@given(depths)
def test_what_is_behind_a_wall_is_not_seen(values: list[float]) -> None:
    weights, after = weights_from_optical_depth(_tensor([math.inf, *values])[None])
    assert weights[0, 0] == 1.0 and not weights[0, 1:].any() and after.item() == 0.0


@LAW
@given(depths)
def test_gradients_of_a_rays_colour_are_finite(values: list[float]) -> None:
    depth = _tensor(values)[None].requires_grad_()
    weights, after = weights_from_optical_depth(depth)
    (weights.square().sum() + after.sum()).backward()
    assert depth.grad is not None and torch.isfinite(depth.grad).all()


@LAW
@given(st.lists(st.floats(0.0, 1e3, width=32), min_size=1, max_size=50), st.integers(-100, 20))
def test_the_median_does_not_depend_on_the_scale_of_the_weights(values: list[float], power: int) -> None:
    weights = np.array(values)[None]
    index = weighted_median_index(weights)
    assert 0 <= index.item() < len(values)
    assert weighted_median_index(weights * 2.0**power).item() == index.item()
    sums = weights.cumsum(axis=1)[0]
    assert sums[index] >= 0.5 * sums[-1]
    assert index == 0 or sums[index - 1] <= 0.5 * sums[-1]


@LAW
@given(st.floats(0.0, 1e6, width=32), st.floats(0.0, 1e6, width=32), st.integers(1, 200), st.booleans())
def test_samples_ascend_from_near_to_far(near: float, length: float, count: int, jitter: bool) -> None:
    start = torch.tensor([near])
    end = torch.maximum(start + length, start)
    generator = torch.Generator().manual_seed(0) if jitter else None
    t, delta = uniform_samples(start, end, count, generator)
    assert t.shape == delta.shape == (1, count)
    assert (t.diff(dim=1) >= 0.0).all() and (delta >= 0.0).all()
    assert t.min() >= start and t.max() <= end


@LAW
@given(st.lists(st.floats(0.0, 1.0), min_size=2, max_size=20), st.floats(0.1, 80.0))
def test_the_depth_loss_is_bounded_by_its_clamp(shares: list[float], true_m: float) -> None:
    weights = torch.tensor([shares], dtype=torch.float64)
    weights = weights / max(1.0, weights.sum().item())
    ranges = torch.linspace(0.1, 120.0, len(shares), dtype=torch.float64)[None]
    loss = depth_loss(weights, ranges, torch.tensor([true_m], dtype=torch.float64)).item()
    assert -1e-12 <= loss <= CLAMP_M + 1e-12
