"""Laws of bilinear samples of feature planes: the oracle against torch's own, and its contract."""

import math

import pytest
import torch

from nvsf_core.errors import ShapeError
from nvsf_core.kernels.encodings.planes import planes_sample


def _plane(*shape):
    generator = torch.Generator().manual_seed(0)
    return torch.empty(shape, dtype=torch.float64).uniform_(-1, 1, generator=generator)


@pytest.mark.parametrize("shape", [(3, 7, 12), (2, 1, 5), (2, 6, 1), (1, 1, 1)], ids=str)
def test_the_oracle_is_torchs_grid_sample_with_its_gradients(shape):
    generator = torch.Generator().manual_seed(1)
    where = torch.rand(200, 2, generator=generator, dtype=torch.float64) * 1.4 - 0.2
    found = where.clone().requires_grad_(), _plane(*shape).requires_grad_()
    expected = where.clone().requires_grad_(), _plane(*shape).requires_grad_()
    sampled = planes_sample(*found, backend="torch")
    known = torch.nn.functional.grid_sample(
        expected[1][None], (expected[0] * 2 - 1)[None, None], padding_mode="border", align_corners=True
    )[0, :, 0].t()
    torch.testing.assert_close(sampled, known)
    sampled.square().sum().backward()
    known.square().sum().backward()
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a.grad, b.grad)


def test_grid_points_are_met_and_columns_run_along_the_first_coordinate():
    plane = _plane(2, 3, 5)
    sampled = planes_sample(torch.tensor([[0.25, 0.5], [1.0, 0.0], [1.0, 1.0]]).double(), plane)
    torch.testing.assert_close(sampled, torch.stack([plane[:, 1, 1], plane[:, 0, 4], plane[:, 2, 4]]))


@pytest.mark.parametrize("axis", [0, 1])
def test_a_nan_coordinate_stays_nan_and_alone(axis):
    where = torch.full((3, 2), 0.4)
    where[1, axis] = math.nan
    sampled = planes_sample(where, _plane(2, 4, 4).float())
    assert torch.isnan(sampled).all(dim=1).tolist() == [False, True, False]


def test_wrong_shapes_are_refused():
    with pytest.raises(ShapeError, match=r"\(n, 2\)"):
        planes_sample(torch.zeros(4, 3), torch.zeros(1, 2, 2))
    with pytest.raises(ShapeError, match="features, height, width"):
        planes_sample(torch.zeros(4, 2), torch.zeros(2, 2))
