"""The paper's terms against hand-computed numbers."""

import pytest
import torch

from nvsf_core.errors import DivergedError, ShapeError
from nvsf_core.losses.chamfer import (
    chamfer_distance,
    flow_magnitude,
    nearest_by_all_pairs,
    ray_batch_chamfer,
    scene_flow_loss,
    squared_nearest_distances,
)
from nvsf_core.losses.gradient import gradient_loss
from nvsf_core.losses.lidar import absolute_range_error, squared_hit_error, squared_intensity_error
from nvsf_core.losses.total import total_loss

INSIDE = torch.ones(1, 2, 3, dtype=torch.bool)


def test_terms_of_a_ray_are_the_papers() -> None:
    assert torch.equal(
        absolute_range_error(torch.tensor([2.0, 5.0]), torch.tensor([3.5, 0.0])), torch.tensor([1.5, 0.0])
    )
    returned = torch.tensor([True, False])
    dark = squared_intensity_error(torch.tensor([0.5, 0.9]), torch.tensor([0.25, 0.0]), returned)
    assert torch.equal(dark, torch.tensor([0.0625, 0.0]))
    assert torch.equal(squared_hit_error(torch.tensor([0.5, 0.25]), returned), torch.tensor([0.25, 0.0625]))


def test_a_nan_at_a_dropped_ray_stays_visible() -> None:
    nan, none = torch.tensor([torch.nan]), torch.zeros(1)
    assert absolute_range_error(nan, none).isnan().all()
    assert squared_intensity_error(nan, none, none.bool()).isnan().all()
    assert gradient_loss(nan.expand(1, 2, 3), torch.zeros(1, 2, 3), INSIDE, INSIDE).isnan().any()


def test_gradient_loss_counts_each_difference_once_with_its_sign() -> None:
    true = torch.tensor([[[10.0, 11.0, 12.0], [10.0, 11.0, 12.0]]])
    rendered = torch.tensor([[[10.0, 9.0, 12.0], [10.0, 11.0, 15.0]]])
    # x errors: row 0: (10-9)-(10-11) = 2, (9-12)-(-1) = -2; row 1: 0, -3. y errors: 0, -2, -3.
    loss = gradient_loss(rendered, true, INSIDE, INSIDE)
    assert torch.equal(loss, torch.tensor([[[2.0, 2.0 + 2.0, 3.0], [0.0, 3.0, 0.0]]]))
    squared = gradient_loss(rendered, true, INSIDE, INSIDE, "mse")
    assert torch.equal(squared, torch.tensor([[[4.0, 4.0 + 4.0, 9.0], [0.0, 9.0, 0.0]]]))
    assert torch.equal(gradient_loss(rendered, true, ~INSIDE, INSIDE).sum(), torch.tensor(5.0))
    mirrored = gradient_loss(2 * true.flip(2), true, INSIDE, ~INSIDE)
    assert float(mirrored.sum()) == 4 * 3.0


def test_a_constant_offset_has_no_gradient_error() -> None:
    true = 5.0 + torch.rand(3, 2, 8, generator=torch.Generator().manual_seed(0))
    inside = torch.ones(3, 2, 8, dtype=torch.bool)
    assert gradient_loss(true + 2.0, true, inside, inside).max() < 1e-5


def test_a_dropped_pixel_compares_the_range_beside_it() -> None:
    true = torch.tensor([[[10.0, 0.0]]])
    loss = gradient_loss(torch.tensor([[[11.0, 30.0]]]), true, true > 0, true > 0)
    assert loss.tolist() == [[[1.0, 0.0]]]
    with pytest.raises(ShapeError):
        gradient_loss(true[0], true[0], true[0] > 0, true[0] > 0)


def test_chamfer_is_the_mean_squared_distance_both_ways() -> None:
    points = torch.tensor([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0]], requires_grad=True)
    others = torch.tensor([[1.0, 0.0, 0.0]])
    distance = chamfer_distance(points, others)
    assert distance.item() == (1.0 + 9.0) / 2 + 1.0
    distance.backward()
    # d/dp of mean |p - q|^2, and of the nearest of q.
    assert torch.equal(points.grad[:, 0], torch.tensor([-1.0 - 2.0, 3.0]))


def test_nearest_distances_are_those_of_all_pairs() -> None:
    generator = torch.Generator().manual_seed(0)
    a, b = 100.0 + torch.rand(300, 3, generator=generator), 100.0 + torch.rand(170, 3, generator=generator)
    by_tree = squared_nearest_distances(a, b)
    by_hand = ((a.double()[:, None] - b.double()) ** 2).sum(dim=2)
    for found, axis in zip(by_tree, (1, 0), strict=True):
        assert torch.allclose(found.double(), by_hand.min(dim=axis).values, atol=1e-5)
    assert torch.equal(nearest_by_all_pairs(a, b), by_hand.argmin(dim=1))


def test_all_pairs_in_many_chunks_are_the_same(monkeypatch) -> None:
    generator = torch.Generator().manual_seed(0)
    a, b = torch.rand(50, 3, generator=generator), torch.rand(7, 3, generator=generator)
    whole = nearest_by_all_pairs(a, b)
    monkeypatch.setattr("nvsf_core.losses.chamfer._CHUNK_PAIRS", 20)
    assert torch.equal(nearest_by_all_pairs(a, b), whole)


def test_a_cloud_that_is_empty_or_not_finite_is_refused() -> None:
    one = torch.zeros(1, 3)
    with pytest.raises(ShapeError):
        chamfer_distance(one, one[:0])
    with pytest.raises(DivergedError):
        chamfer_distance(one * torch.nan, one)


def test_batch_chamfer_leaves_dropped_rays_at_the_origin() -> None:
    direction = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    loss = ray_batch_chamfer(direction, torch.tensor([3.0, 7.0]), torch.tensor([2.0, 0.0]))
    assert torch.equal(loss, torch.tensor([0.5 * (1.0 + 1.0), 0.0]))


def test_the_true_flow_has_no_flow_loss_and_each_neighbour_its_own_term() -> None:
    cloud = torch.rand(40, 3, generator=torch.Generator().manual_seed(0))
    step = torch.tensor([0.3, 0.0, 0.0]).expand(40, 3)
    true = scene_flow_loss(cloud, step, -step, cloud + step, cloud - step)
    assert true.shape == (2,) and true.max() < 1e-10
    still = torch.zeros(40, 3, requires_grad=True)
    terms = scene_flow_loss(cloud, still, still, cloud + step, None)
    assert terms.shape == (1,) and terms[0].item() > 1e-3
    terms.sum().backward()
    assert float(still.grad[:, 0].sum()) < 0.0
    assert scene_flow_loss(cloud, step, step, None, None).shape == (0,)
    assert scene_flow_loss(cloud, step, step, cloud[:0], None).shape == (0,)
    assert scene_flow_loss(cloud[:0], step[:0], step[:0], cloud, None).shape == (0,)
    with pytest.raises(ShapeError):
        scene_flow_loss(cloud, step[:3], step, cloud, None)


def test_flow_magnitude_is_the_mean_absolute_component() -> None:
    assert float(flow_magnitude(torch.ones(2, 3), torch.full((2, 3), -3.0)).mean()) == 2.0


def test_total_adds_sums_and_means_as_named() -> None:
    terms = {"a": torch.tensor([1.0, 3.0]), "b": torch.tensor([1.0, 3.0])}
    loss = total_loss(terms, {"a": 10.0, "b": 1.0}, sums={"a"})
    assert loss.terms == {"a": 4.0, "b": 2.0}
    assert float(loss.total) == 42.0


def test_sums_of_parts_add_up_to_the_whole() -> None:
    x = torch.arange(10.0)
    parts = [float(total_loss({"a": part}, {"a": 0.5}, sums={"a"}).total) for part in x.split(3)]
    assert sum(parts) == float(total_loss({"a": x}, {"a": 0.5}, sums={"a"}).total)


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_a_term_that_is_not_finite_is_named(bad: float) -> None:
    with pytest.raises(DivergedError, match="'gradient'"):
        total_loss({"a": torch.ones(2), "gradient": torch.tensor([bad])}, {"a": 1.0, "gradient": 0.0})


def test_a_total_of_nothing_is_zero_and_has_a_gradient() -> None:
    loss = total_loss({"a": torch.zeros(0)}, {"a": 1.0})
    loss.total.backward()
    assert loss.total.item() == 0.0 and loss.terms == {}
