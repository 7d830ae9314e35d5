"""Laws of the kernels: encodings, composited rays, averages; references are sums in float64."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from benchmarks.numerics.cases.tolerances import EPS, SUM_EPS
from nvsf_core.kernels.composite import composite_rays
from nvsf_core.kernels.encodings.hash_grid import GridLayout, hash_grid_encode
from nvsf_core.kernels.encodings.planes import planes_sample
from nvsf_core.metrics.ssim import ssim
from nvsf_core.training.weight_average import WeightAverage

LAW = settings(derandomize=True, deadline=None, max_examples=30, database=None)
LAYOUT = GridLayout(levels=4, features=2, log2_table=9, base_resolution=4, finest_resolution=256)
seeds = st.integers(0, 2**32 - 1)


def _singles(least: float, most: float) -> st.SearchStrategy[float]:
    # Kernels flush the smallest of all numbers to 0.
    return st.floats(least, most, width=32, allow_subnormal=False)


# Far outside the box, too, and on the borders of cells.
places = st.one_of(_singles(-(2.0**100), 2.0**100), _singles(0.0, 1.0), st.sampled_from([0.0, 0.5, 1.0]))
points = st.lists(st.tuples(places, places, places), min_size=1, max_size=20)
logits = st.lists(_singles(-1e4, 1e4), min_size=0, max_size=12)


def _table(seed: int, *shape: int) -> Tensor:
    return torch.empty(shape).uniform_(-1.0, 1.0, generator=torch.Generator().manual_seed(seed))


def _check_handed_down(value: Tensor, entries: Tensor, seed: int) -> None:
    """A value is linear in its entries: weighted alike, it and their gradients give the same sum."""
    weight = _table(seed + 1, *value.shape)
    value.backward(weight)
    assert entries.grad is not None
    up, down = (value.detach().double() * weight).sum(), (entries.detach().double() * entries.grad).sum()
    assert abs(float(up - down)) <= SUM_EPS * EPS * (1.0 + float(value.detach().abs().sum()))


@LAW
@given(seeds, points)
def test_an_encoding_is_a_mean_of_its_entries(seed: int, where: list[tuple[float, float, float]]) -> None:
    x = torch.tensor(where)
    value = hash_grid_encode(x, _table(seed, LAYOUT.entries, 2), LAYOUT)
    assert value.abs().max() <= 1.0 + 8 * EPS
    alike = hash_grid_encode(x, torch.full((LAYOUT.entries, 2), 0.75), LAYOUT)
    assert (alike - 0.75).abs().max() <= 16 * EPS
    assert torch.equal(value, hash_grid_encode(x.clamp(0.0, 1.0), _table(seed, LAYOUT.entries, 2), LAYOUT))


@LAW
@given(seeds, points)
def test_what_an_encoding_hands_down_is_what_it_took_up(
    seed: int, where: list[tuple[float, float, float]]
) -> None:
    x, table = torch.tensor(where), _table(seed, LAYOUT.entries, 2).requires_grad_()
    _check_handed_down(hash_grid_encode(x, table, LAYOUT), table, seed)


@LAW
@given(seeds, points)
def test_a_planes_sample_is_a_mean_and_hands_down_what_it_took_up(
    seed: int, where: list[tuple[float, float, float]]
) -> None:
    x, plane = torch.tensor(where)[:, :2].contiguous(), _table(seed, 3, 9, 17).requires_grad_()
    value = planes_sample(x, plane)
    assert value.abs().max() <= 1.0 + 8 * EPS
    _check_handed_down(value, plane, seed)


@LAW
@given(seeds, st.lists(logits, min_size=1, max_size=5))
def test_a_rays_surfaces_share_what_they_do_not_let_through(seed: int, rays: list[list[float]]) -> None:
    logit = torch.tensor([value for ray in rays for value in ray], requires_grad=True)
    first = torch.tensor(np.cumsum([0, *map(len, rays)]))
    count = len(logit)
    weights, summary, index, *_ = composite_rays(
        logit, torch.rand(count), _table(seed, count, 3), torch.rand(count, 6), first,
        torch.full((count,), -1.0), torch.full((len(rays),), 0.5),
    )  # fmt: skip
    for ray, values in enumerate(rays):
        own = weights.detach()[first[ray] : first[ray + 1]].double()
        through = np.prod(1.0 / (1.0 + np.exp(np.clip(np.array(values, np.float64), -700.0, 700.0))))
        assert (own >= 0.0).all() and (own <= 1.0).all()
        assert float(own.sum()) == pytest.approx(1.0 - through, abs=SUM_EPS * EPS)
        assert first[ray] <= index[ray] <= max(first[ray], first[ray + 1] - 1)
    (weights.square().sum() + summary.sum()).backward()
    assert logit.grad is not None and torch.isfinite(logit.grad).all()


@LAW
@given(seeds, st.floats(0.0, 1.0), st.integers(7, 20), st.integers(7, 20))
def test_similarity_is_mutual_and_whole_only_of_the_same(
    seed: int, noise: float, rows: int, columns: int
) -> None:
    rng = np.random.default_rng(seed)
    one = rng.random((rows, columns))
    other = (1.0 - noise) * one + noise * rng.random((rows, columns))
    there, back = ssim(one, other, 1.0).value, ssim(other, one, 1.0).value
    assert there == pytest.approx(back, rel=1e-12) and -1.0 <= there <= 1.0 + 1e-12
    assert ssim(one, one, 1.0).value == pytest.approx(1.0, abs=1e-12)
    assert there < 1.0 or noise < 1e-6


@LAW
@given(st.lists(_singles(-1e6, 1e6), min_size=1, max_size=30), st.floats(0.5, 0.999))
def test_an_average_lies_among_what_it_took_in_and_keeps_what_never_changes(
    values: list[float], decay: float
) -> None:
    model = nn.Linear(1, 1)
    nn.init.constant_(model.weight, values[0])
    nn.init.constant_(model.bias, 3.0)
    average = WeightAverage(model, decay)
    for value in values:
        nn.init.constant_(model.weight, value)
        average.update()
    found = average.tensors()
    slack = SUM_EPS * EPS * max(map(abs, values))
    assert min(values) - slack <= float(found["ema.weight"]) <= max(values) + slack
    assert float(found["ema.bias"]) == 3.0
