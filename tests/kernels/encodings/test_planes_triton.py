"""Laws of the planes' Triton kernels: on the CPU by Triton's interpreter, on CUDA where there is one."""

import importlib.util
import itertools
import math

import pytest
import torch

from nvsf_core.errors import ShapeError
from nvsf_core.kernels.encodings.planes import planes_sample

pytestmark = pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="Triton is not installed")
on_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")


def _plane(shape, device="cpu"):
    return torch.empty(shape).uniform_(-1, 1, generator=torch.Generator().manual_seed(0)).to(device)


def _hard_coordinates(height, width):
    """Grid points, the square's corners, outside of it, infinities, NaN along each axis; over one block."""
    generator = torch.Generator().manual_seed(1)
    lines = [torch.arange(size) / max(size - 1, 1) for size in (width, height)]
    picked = [line[torch.randint(len(line), (60,), generator=generator)] for line in lines]
    return torch.cat(
        [
            torch.stack(picked, dim=1),
            torch.rand(30, 2, generator=generator),
            torch.tensor(list(itertools.product([0.0, 1.0], repeat=2))),
            torch.randn(40, 2, generator=generator) * 3,
            torch.tensor([[math.inf, -math.inf], [-0.0, 1e30], [math.nan, 0.3], [0.6, math.nan]]),
        ]
    )


def _value_and_gradients(coordinates, plane, backend):
    coordinates, plane = coordinates.detach().requires_grad_(), plane.detach().requires_grad_()
    sampled = planes_sample(coordinates, plane, backend=backend)
    sampled.backward(torch.randn(sampled.shape, generator=torch.Generator().manual_seed(3)).to(sampled))
    return sampled.detach(), plane.grad, coordinates.grad


def _assert_equal_to_the_oracle(coordinates, plane):
    found = _value_and_gradients(coordinates, plane, "triton")
    for value, expected in zip(found, _value_and_gradients(coordinates, plane, "torch"), strict=True):
        known = expected[expected.isfinite()]
        largest = max(1.0, known.abs().max().item()) if known.numel() else 1.0
        torch.testing.assert_close(value, expected, rtol=1e-5, atol=1e-6 * largest, equal_nan=True)


@pytest.mark.parametrize("shape", [(1, 5, 9), (2, 1, 6), (3, 7, 1), (4, 1, 1), (8, 33, 12)], ids=str)
def test_triton_equals_the_oracle_on_hard_inputs(device, shape):
    coordinates = _hard_coordinates(*shape[1:]).to(device)
    _assert_equal_to_the_oracle(coordinates, _plane(shape, device))


@pytest.mark.parametrize("points", [0, 1, 128])
def test_triton_equals_the_oracle_for_any_number_of_points(device, points):
    coordinates = torch.rand(points, 2, generator=torch.Generator().manual_seed(2)).to(device)
    _assert_equal_to_the_oracle(coordinates, _plane((8, 64, 64), device))


def test_planes_of_any_memory_order_are_sampled_alike(device):
    coordinates, plane = _hard_coordinates(5, 6).to(device), _plane((2, 5, 6), device)
    features_last = plane.permute(1, 2, 0).contiguous().permute(2, 0, 1)
    sampled = planes_sample(coordinates.t().contiguous().t(), features_last, backend="triton")
    assert torch.equal(
        sampled.nan_to_num(9), planes_sample(coordinates, plane, backend="triton").nan_to_num(9)
    )


def test_other_types_than_float32_are_refused(device):
    with pytest.raises(ShapeError, match="triton"):
        planes_sample(torch.zeros(4, 2, device=device).double(), _plane((1, 3, 3), device), backend="triton")


@on_cuda
def test_cuda_samples_with_triton_as_the_oracle_does_at_the_papers_size():
    coordinates = torch.rand(100_000, 2, generator=torch.Generator().manual_seed(4)).cuda()
    plane = _plane((8, 512, 512), "cuda")
    _assert_equal_to_the_oracle(coordinates, plane)
    sampled = planes_sample(coordinates, plane.requires_grad_())
    assert sampled.grad_fn.kernels.backend == "triton"


@on_cuda
def test_ten_million_points_on_cuda():
    generator = torch.Generator("cuda").manual_seed(5)
    coordinates = torch.rand(10_000_000, 2, generator=generator, device="cuda")
    plane = _plane((8, 512, 512), "cuda")
    sample = torch.randint(len(coordinates), (100_000,), generator=generator, device="cuda")
    whole = planes_sample(coordinates, plane)
    for first in range(0, len(coordinates), 3_000_017):
        part = slice(first, first + 3_000_017)
        assert torch.equal(planes_sample(coordinates[part], plane), whole[part])
    expected = planes_sample(coordinates[sample], plane, backend="torch")
    torch.testing.assert_close(whole[sample], expected, rtol=1e-5, atol=1e-6)
