"""Losses against hand-computed numbers."""

import math

import torch

from nvsf_core.losses.lidar import depth_loss, intensity_loss, raydrop_loss
from nvsf_core.losses.total import total_loss


def test_depth_is_the_weighted_distance_clamped_plus_what_is_missing() -> None:
    weights = torch.tensor([[0.5, 0.25]])
    range_m = torch.tensor([[10.5, 20.0]])
    # 0.5 * 0.5 + 0.25 * min(10, 3) + 3 * 0.25
    assert torch.allclose(
        depth_loss(weights, range_m, torch.tensor([10.0])), torch.tensor([0.25 + 0.75 + 0.75])
    )


def test_a_coin_costs_the_log_of_two() -> None:
    loss = raydrop_loss(torch.zeros(2), torch.tensor([0.0, 1.0]))
    assert torch.allclose(loss, torch.full((2,), math.log(2.0)))


def test_intensity_is_a_squared_error() -> None:
    assert torch.allclose(intensity_loss(torch.zeros(1), torch.tensor([0.2])), torch.tensor([0.09]))


def test_a_term_in_double_precision_is_reported_as_it_is() -> None:
    """Larger than any number in single precision, it is no divergence."""
    loss = total_loss({"a": torch.tensor([1e300], dtype=torch.float64)}, {"a": 1.0})
    assert loss.terms == {"a": 1e300}


def test_an_empty_term_is_absent_and_not_nan() -> None:
    loss = total_loss({"a": torch.tensor([2.0]), "b": torch.zeros(0)}, {"a": 0.5, "b": 1.0})
    assert float(loss.total) == 1.0
    assert loss.terms == {"a": 2.0}
