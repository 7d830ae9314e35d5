"""Laws of the gradient masks."""

import numpy as np
import pytest
import torch

from nvsf_core.errors import RecipeError, ShapeError
from nvsf_core.losses.gradient import gradient_mask, mask_coverage
from nvsf_core.sensors.linear_pano import LinearPano


def test_masks_of_a_row_by_hand() -> None:
    row = torch.tensor([[10.0, 10.5, 11.25, 12.0, 30.0, 30.01, 0.0, 5.0]])
    # |g| = .5 .75 .75 18 .01 30.01 5 (5); changes .25 0 17.25 17.99 30 25.01 0 (0)
    along_x, along_y = gradient_mask(row, "double", 0.05)
    assert along_x[0].tolist() == [False, True, False, False, False, False, False, True]
    assert not along_y.any()
    along_x, _ = gradient_mask(row, "single", 0.05)
    assert along_x[0].tolist() == [False, False, False, False, True, False, False, False]


def test_rows_are_columns_turned() -> None:
    pano = 10.0 + torch.rand(7, 9, generator=torch.Generator().manual_seed(0))
    pano[3, 4] = 0.0
    for kind in ("double", "single"):
        x, y = gradient_mask(pano, kind, 0.2)
        turned_x, turned_y = gradient_mask(pano.T, kind, 0.2)
        assert torch.equal(y, turned_x.T) and torch.equal(x, turned_y.T)
        assert x.any() and not x.all()


def test_frames_are_masked_each_for_itself() -> None:
    panos = 10.0 + torch.rand(3, 5, 6, generator=torch.Generator().manual_seed(0))
    together = gradient_mask(panos, "double", 0.1)[0]
    assert torch.equal(together, torch.stack([gradient_mask(pano, "double", 0.1)[0] for pano in panos]))


def test_a_pixel_without_return_is_never_inside() -> None:
    assert not gradient_mask(torch.zeros(4, 4), "double", 0.05)[0].any()
    assert not gradient_mask(torch.zeros(4, 4), "single", 0.05)[1].any()


def test_a_lone_spike_passes_the_double_mask_but_an_edge_does_not() -> None:
    spike = torch.tensor([[10.0, 10.0, 10.0, 15.0, 10.0, 10.0, 10.0]])
    assert gradient_mask(spike, "double", 0.05)[0][0].tolist() == [True, False, True, False, True, True, True]
    edge = torch.tensor([[10.0, 10.0, 10.0, 15.0, 15.0, 15.0, 15.0]])
    assert gradient_mask(edge, "double", 0.05)[0][0].tolist() == [True, False, False, True, True, True, True]


@pytest.mark.parametrize("kind", ["double", "single"])
@pytest.mark.parametrize("shape", [(1, 8), (8, 1), (1, 1)])
def test_an_axis_of_one_pixel_has_no_gradient(kind, shape):
    for mask, length in zip(gradient_mask(torch.ones(shape), kind, 0.05), shape[::-1], strict=True):
        assert mask.shape == shape and bool(mask.all()) == (length > 1)


def test_thresholds_and_shapes_are_checked() -> None:
    for bad in (0.0, -1.0, float("nan")):
        with pytest.raises(RecipeError):
            gradient_mask(torch.ones(2, 2), "double", bad)
    with pytest.raises(ShapeError):
        gradient_mask(torch.ones(3), "single", 0.1)


def test_coverage_counts_returns_by_band() -> None:
    range_m = torch.tensor([[0.0, 5.0, 9.0, 10.0, 79.0, 80.0]])
    inside = torch.tensor([[True, True, False, True, False, True]])
    assert mask_coverage(inside, range_m) == [(2, 1), (1, 1), (0, 0), (1, 0)]


def test_on_a_sloped_noisy_plane_the_double_mask_reaches_farther() -> None:
    # The setting of the notes on the paper's system: a 2 % slope under a sensor at 1.73 m, 1 cm of noise.
    pano = LinearPano()
    directions = pano.directions()
    height = directions[..., 2] - 0.02 * directions[..., 0]
    range_m = np.where(height < 0, -1.73 / np.minimum(height, -1e-9), 0.0)
    range_m = np.where(range_m < 80.0, range_m, 0.0)
    noisy = range_m + np.random.default_rng(0).normal(0.0, 0.01, range_m.shape) * (range_m > 0)
    ranges = torch.from_numpy(noisy)
    shares = {}
    for kind, threshold_m in (("single", 0.01), ("double", 0.05), ("single", 0.05)):
        bands = mask_coverage(gradient_mask(ranges, kind, threshold_m)[0], ranges)
        shares[kind, threshold_m] = [inside / max(1, count) for count, inside in bands]
    assert shares["single", 0.01] == pytest.approx([0.51, 0.42, 0.14, 0.04], abs=0.03)
    assert shares["double", 0.05] == pytest.approx([1.0, 1.0, 0.97, 0.96], abs=0.03)
    assert shares["single", 0.05] == pytest.approx([1.0, 1.0, 0.72, 0.17], abs=0.03)
