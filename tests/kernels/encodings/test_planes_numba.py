"""Laws of the planes' numba kernels: the oracle on hard inputs, bits, the choice of the backend."""

import itertools
import math

import numba
import pytest
import torch

from nvsf_core.errors import ShapeError
from nvsf_core.kernels.encodings.planes import planes_sample

SHAPES = [
    (1, 5, 9),
    (3, 1, 6),
    (3, 7, 1),
    (1, 1, 1),
    (8, 33, 12),
]  # a kernel is compiled for each number of features
MOST = numba.config.NUMBA_NUM_THREADS


def _plane(shape):
    return torch.empty(shape).uniform_(-1, 1, generator=torch.Generator().manual_seed(0))


def _coordinates(kind, height, width):
    generator = torch.Generator().manual_seed(1)
    if kind == "grid points":
        lines = [torch.arange(size) / max(size - 1, 1) for size in (width, height)]
        return torch.stack([line[torch.randint(len(line), (600,), generator=generator)] for line in lines], 1)
    if kind == "corners of the square":
        return torch.tensor(list(itertools.product([0.0, 1.0], repeat=2)))
    if kind == "outside":
        far = torch.tensor([[math.inf, -math.inf], [-0.0, 1e30], [-1e30, 0.3]])
        return torch.cat([torch.randn(300, 2, generator=generator) * 3, far])
    if kind == "NaN":
        return torch.tensor([[0.2, 0.3], [math.nan, 0.3], [0.6, math.nan], [math.nan, math.nan]])
    return torch.rand(
        {"random": 1003, "whole blocks": 512, "none": 0, "one": 1}[kind], 2, generator=generator
    )


KINDS = [
    "random", "whole blocks", "grid points", "corners of the square", "outside", "NaN", "none", "one",
]  # fmt: skip


def _value_and_gradients(coordinates, plane, backend):
    coordinates, plane = coordinates.detach().requires_grad_(), plane.detach().requires_grad_()
    sampled = planes_sample(coordinates, plane, backend=backend)
    sampled.backward(torch.randn(sampled.shape, generator=torch.Generator().manual_seed(3)))
    return sampled.detach(), plane.grad, coordinates.grad


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_numba_equals_the_oracle(shape, kind):
    coordinates = _coordinates(kind, *shape[1:])
    found = _value_and_gradients(coordinates, _plane(shape), "numba")
    assert found[0].shape == (len(coordinates), shape[0])
    for value, expected in zip(found, _value_and_gradients(coordinates, _plane(shape), "torch"), strict=True):
        known = expected[expected.isfinite()]
        largest = max(1.0, known.abs().max().item()) if known.numel() else 1.0
        torch.testing.assert_close(value, expected, rtol=1e-5, atol=1e-6 * largest, equal_nan=True)


def test_float32_on_the_cpu_is_numbas():
    coordinates, plane = _coordinates("random", 33, 12), _plane((8, 33, 12)).requires_grad_()
    assert planes_sample(coordinates, plane).grad_fn.kernels.backend == "numba"
    assert not hasattr(planes_sample(coordinates.double(), plane).grad_fn, "kernels")


def test_the_adjoint_is_the_transpose_of_the_sampling():
    coordinates, plane = _coordinates("random", 33, 12), _plane((8, 33, 12))
    cotangent = torch.randn(len(coordinates), 8, generator=torch.Generator().manual_seed(4))
    trained = torch.zeros_like(plane).requires_grad_()
    planes_sample(coordinates, trained).backward(cotangent)
    forward = (planes_sample(coordinates, plane).double() * cotangent).sum()
    assert forward.item() == pytest.approx((plane.double() * trained.grad).sum().item(), rel=1e-4)


def test_the_same_bits_for_every_run_and_thread_count():
    coordinates, plane = _coordinates("random", 33, 12), _plane((8, 33, 12))
    before = numba.get_num_threads()
    results = []
    try:
        for threads in (1, MOST, MOST):
            numba.set_num_threads(threads)
            results.append(_value_and_gradients(coordinates, plane, "numba"))
    finally:
        numba.set_num_threads(before)
    for result in results[1:]:
        assert all(torch.equal(found, first) for found, first in zip(result, results[0], strict=True))


def test_views_that_are_not_contiguous_are_sampled_alike():
    coordinates, plane = _coordinates("random", 33, 12), _plane((8, 33, 12))
    features_last = plane.permute(1, 2, 0).contiguous().permute(2, 0, 1)
    sampled = planes_sample(coordinates.t().contiguous().t(), features_last, backend="numba")
    assert torch.equal(sampled, planes_sample(coordinates, plane, backend="numba"))


def test_other_types_than_float32_are_refused():
    with pytest.raises(ShapeError, match="numba"):
        planes_sample(torch.zeros(4, 2).double(), _plane((1, 3, 3)), backend="numba")
