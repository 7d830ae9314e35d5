"""Laws of alpha compositing."""

import math

import pytest
import torch

from nvsf_core.errors import ShapeError
from nvsf_core.rendering.volume import weights_from_optical_depth


def _depths(rays=50, samples=70, scale=0.1):
    return torch.rand(rays, samples, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * scale


def test_the_weights_are_the_product_formula():
    tau = _depths()
    alpha = 1 - torch.exp(-tau)
    passed = torch.cumprod(torch.cat([torch.ones(len(tau), 1).double(), 1 - alpha], dim=1), dim=1)
    weights, after = weights_from_optical_depth(tau)
    assert torch.allclose(weights, alpha * passed[:, :-1])
    assert torch.allclose(after, passed[:, -1])


@pytest.mark.parametrize("scale", [0.0, 1e-12, 1e-3, 1.0, 1e3, 1e30, math.inf])
def test_weights_and_what_passes_sum_to_one(scale):
    tau = _depths().float() * scale if scale else torch.zeros(50, 70)
    tau = torch.nan_to_num(tau, nan=0.0, posinf=math.inf)
    weights, after = weights_from_optical_depth(tau)
    assert ((weights >= 0) & (weights <= 1)).all()
    assert (weights.sum(dim=1) + after - 1).abs().max() < 1e-5


def test_thin_samples_keep_weight_and_gradient_in_float32():
    tau = torch.full((1, 4), 1e-10).requires_grad_()
    weights, _ = weights_from_optical_depth(tau)
    weights.sum().backward()
    assert weights[0].tolist() == pytest.approx([1e-10] * 4, rel=1e-5)
    assert tau.grad[0].tolist() == pytest.approx([1.0] * 4, rel=1e-5)


def test_extremes_have_finite_gradients():
    x = torch.tensor([[0.0, 1e-38, 1.0, 90.0, 1e30, math.inf, 5.0, 0.0]]).requires_grad_()
    weights, after = weights_from_optical_depth(x)
    (weights.square().sum() + after.sum()).backward()
    assert torch.isfinite(weights).all()
    assert torch.isfinite(after).all()
    assert torch.isfinite(x.grad).all()


def test_the_weights_pass_gradcheck():
    x = (_depths(3, 6, 2.0) + 0.01).requires_grad_()
    assert torch.autograd.gradcheck(weights_from_optical_depth, (x,))


def test_nothing_behind_an_opaque_sample_is_seen():
    weights, after = weights_from_optical_depth(torch.tensor([[0.0, math.inf, 3.0]]))
    assert weights.tolist() == [[0.0, 1.0, 0.0]]
    assert after.tolist() == [0.0]


def test_a_ray_without_samples_passes_whole():
    weights, after = weights_from_optical_depth(torch.zeros(3, 0))
    assert weights.shape == (3, 0)
    assert after.tolist() == [1.0] * 3
    with pytest.raises(ShapeError):
        weights_from_optical_depth(torch.zeros(3))
