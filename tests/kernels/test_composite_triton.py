"""Laws of compositing by Triton: on the CPU by Triton's interpreter, on CUDA where there is one."""

import importlib.util

import numpy as np
import pytest
import torch

from nvsf_core.kernels.composite import composite_rays

pytestmark = pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="Triton is not installed")


def _surfaces(counts, features, *, moving):
    """Surfaces of rays with `counts` (n,) of them, a few logits extreme; if moving, some are an object's."""
    generator = torch.Generator().manual_seed(0)
    total = int(sum(counts))
    logit = 3.0 * torch.randn(total, generator=generator)
    extremes = torch.tensor([-90.0, 90.0, -30.0, 30.0, -30.0, 90.0])[:total]
    logit[: len(extremes)] = extremes
    own = torch.full((total,), -1.0)
    if moving:
        on_object = torch.rand(total, generator=generator) < 0.4
        own[on_object] = torch.rand(int(on_object.sum()), generator=generator)
    first = torch.from_numpy(np.concatenate([[0], np.cumsum(counts)]).astype(np.int64))
    return (
        logit, 1.0 + 60.0 * torch.rand(total, generator=generator),
        torch.randn(total, features, generator=generator), torch.rand(total, 6, generator=generator), first,
        own, torch.rand(len(counts), generator=generator),
    )  # fmt: skip


def _values_and_gradients(surfaces, backend, device):
    given = [tensor.to(device) for tensor in surfaces]
    for tensor in given[:3]:
        tensor.requires_grad_()
    found = composite_rays(*given, backend=backend)
    generator = torch.Generator().manual_seed(1)
    pulls = [torch.randn(one.shape, generator=generator).to(device) for one in found[:2]]
    torch.autograd.backward(found[:2], pulls)
    return [one.detach().cpu() for one in (*found, *(tensor.grad for tensor in given[:3]))]


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize(("counts", "features"), [((0, 1, 5, 24, 3, 0, 2) * 20, 8), ((3,), 1), ((0, 0), 5)])
def test_triton_equals_numba(device, counts, features, moving):
    surfaces = _surfaces(counts, features, moving=moving)
    found = _values_and_gradients(surfaces, "triton", device)
    expected = _values_and_gradients(surfaces, "numba", device)
    for value, same in zip(found, expected, strict=True):
        torch.testing.assert_close(value, same, rtol=2e-5, atol=2e-5)


def test_gradients_of_features_stored_by_columns_are_those_of_rows(device):
    """`empty_like` keeps strides, and the kernel writes row by row."""
    from nvsf_core.kernels import composite_triton

    given = (one.to(device) for one in _surfaces((3, 5, 2), 4, moving=False))
    logit, range_m, features, facts, first, own, hit_prior = given
    weights, summary = composite_triton.forward(first, logit, range_m, features, facts, own, hit_prior)[:2]
    by_columns = features.T.contiguous().T
    of_rows, of_columns = (
        composite_triton.adjoint(
            first, logit, range_m, one, facts, weights, summary, torch.ones_like(weights),
            torch.ones_like(summary),
        )[2]
        for one in (features, by_columns)
    )  # fmt: skip
    assert torch.equal(of_rows, of_columns)


def test_without_rays_there_is_nothing_to_launch(device):
    found = _values_and_gradients(_surfaces((), 3, moving=False), "triton", device)
    assert [tuple(one.shape) for one in found[:5]] == [(0,), (0, 7), (0,), (0,), (0,)]


def test_a_nan_stays_a_nan_of_its_ray(device):
    surfaces = _surfaces((2, 3, 2), 4, moving=False)
    surfaces[0][3] = torch.nan
    _, summary, *_ = _values_and_gradients(surfaces, "triton", device)
    assert summary[:, 4].isnan().tolist() == [False, True, False]
