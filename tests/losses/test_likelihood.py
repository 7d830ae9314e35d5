"""Laws of the likelihood of a ray's surfaces."""

import torch

from nvsf_core.losses.lidar import depth_loss, surface_likelihood


def best_share(loss, returns_m: torch.Tensor) -> float:
    """Weight of the surface at 10 m, beside one at 14 m, with which recorded ranges (n,) cost least."""
    share = torch.linspace(0.0, 1.0, 201)
    surfaces = torch.tensor([10.0, 14.0]).expand(len(returns_m), 2)
    costs = [
        float(loss(torch.stack([s, 1.0 - s]).expand(len(returns_m), 2), surfaces, returns_m).mean())
        for s in share
    ]
    return float(share[int(torch.tensor(costs).argmin())])


def test_the_best_weights_are_the_shares_of_rays() -> None:
    returns_m = torch.tensor([10.0] * 3 + [14.0] * 7)
    assert abs(best_share(surface_likelihood, returns_m) - 0.3) < 0.02
    # The distance gives everything to what most rays meet: the thin thing is gone.
    assert best_share(depth_loss, returns_m) == 0.0


def test_a_surface_is_pulled_to_its_return_and_an_outlier_pulls_at_nothing() -> None:
    for off_m, pulls in ((0.1, True), (30.0, False)):
        range_m = torch.tensor([[10.0 + off_m]], requires_grad=True)
        surface_likelihood(torch.tensor([[1.0]]), range_m, torch.tensor([10.0])).sum().backward()
        assert (float(range_m.grad) > 1.0) == pulls
        assert abs(float(range_m.grad)) < 5.0
