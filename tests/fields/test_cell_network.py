"""Laws of the network over a turn's cells."""

import torch

from nvsf_core.fields.layers import CellNetwork
from nvsf_core.recipe.residual import PanoSpec

FEATURES, OUTPUTS = 16, 2


def untrained(seed: int) -> CellNetwork:
    return CellNetwork(FEATURES, OUTPUTS, PanoSpec(), torch.Generator().manual_seed(seed))


def drawn(seed: int) -> CellNetwork:
    """A network that has learned something, of whatever sense."""
    network = untrained(seed)
    with torch.no_grad():
        network.layers[-1].weight.normal_(generator=torch.Generator().manual_seed(seed + 1))
    return network


def some_features(seed: int) -> torch.Tensor:
    return torch.randn(2, FEATURES, 9, 14, generator=torch.Generator().manual_seed(seed))


@torch.no_grad()
def test_a_turned_sensor_gets_the_turned_answer() -> None:
    network, features = drawn(0), some_features(2)
    here, turned = network(features), network(features.roll(5, dims=3))
    torch.testing.assert_close(turned, here.roll(5, dims=-1), rtol=1e-5, atol=1e-5)
    assert (here.std(dim=(0, 2, 3)) > 0.1).all()


@torch.no_grad()
def test_before_training_nothing_is_corrected() -> None:
    network = untrained(0)
    assert not network(some_features(3)).any()


def test_it_is_small_and_the_seed_decides_it() -> None:
    first, again, other = (untrained(s) for s in (0, 0, 1))
    assert sum(p.numel() for p in first.parameters()) < 16_000
    assert torch.equal(first.layers[0].weight, again.layers[0].weight)
    assert not torch.equal(first.layers[0].weight, other.layers[0].weight)
