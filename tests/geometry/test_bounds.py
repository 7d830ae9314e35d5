"""Laws of the scene's cube and its units."""

import numpy as np
import pytest
import torch

from nvsf_core.errors import DataError, ShapeError
from nvsf_core.geometry.bounds import Bounds


def _street(points: int = 20_000) -> np.ndarray:
    rng = np.random.default_rng(0)
    return rng.uniform((920.0, 1970.0, 98.0), (1060.0, 2030.0, 108.0), (points, 3))


def test_a_stray_point_moves_the_authors_box_and_not_ours() -> None:
    points_m = _street()
    stray = np.concatenate([points_m, [[1400.0, 2000.0, 100.0]]])
    robust = Bounds.of_points(stray)
    assert robust.half_m == pytest.approx(70.0, abs=0.2)
    assert np.allclose(robust.centre_m, (990.0, 2000.0, 103.0), atol=0.2)
    extreme = Bounds.of_points(stray, outermost_share=0.0)
    assert extreme.half_m == pytest.approx((1400.0 - points_m[:, 0].min()) / 2)


def test_all_but_a_thousandth_of_each_axis_lies_inside() -> None:
    points_m = np.random.default_rng(1).normal(0.0, 1.0, (100_000, 3))
    bounds = Bounds.of_points(points_m)
    outside = np.abs(points_m - bounds.centre_m) > bounds.half_m
    # the cube's edge is the longest axis of the box; the others have fewer points outside
    assert 0.0009 <= outside.mean(axis=0).max() <= 0.0011


def test_bound_two_leaves_half_of_every_axis_empty() -> None:
    points_m = _street(1000)
    box = torch.from_numpy(points_m)
    one = Bounds.of_points(points_m, outermost_share=0.0).to_unit(box)
    two = Bounds.of_points(points_m, outermost_share=0.0, bound=2.0).to_unit(box)
    assert (one[:, 0].min().item(), one[:, 0].max().item()) == pytest.approx((0.0, 1.0))
    assert (two[:, 0].min().item(), two[:, 0].max().item()) == pytest.approx((0.25, 0.75))


def test_units_go_there_and_back() -> None:
    points_m = torch.from_numpy(_street(1000))
    bounds = Bounds.of_points(_street(1000), bound=2.0)
    scaled = bounds.to_scaled(points_m)
    assert torch.allclose(bounds.to_metres(scaled), points_m, atol=1e-9)
    assert torch.allclose(scaled / (2 * bounds.bound) + 0.5, bounds.to_unit(points_m))
    step_m = torch.linalg.norm(points_m[0] - points_m[1]).item()
    assert bounds.scaled(step_m) == pytest.approx(torch.linalg.norm(scaled[0] - scaled[1]).item())


def test_what_is_no_scene_is_refused() -> None:
    with pytest.raises(ShapeError):
        Bounds.of_points(np.zeros((0, 3)))
    with pytest.raises(DataError, match="1 of 2"):
        Bounds.of_points(np.array([[0.0, 0.0, np.nan], [1.0, 1.0, 1.0]]))
    with pytest.raises(DataError, match="the same"):
        Bounds.of_points(np.ones((5, 3)))
