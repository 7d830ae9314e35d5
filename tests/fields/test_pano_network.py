"""Laws of the network over a pano's cells."""

import torch

from nvsf_core.fields.pano_network import FEATURES, PanoNetwork
from nvsf_core.recipe import PanoSpec


def drawn(seed: int) -> PanoNetwork:
    """A network that has learned something, of whatever sense."""
    network = PanoNetwork(PanoSpec(), torch.Generator().manual_seed(seed))
    with torch.no_grad():
        network.layers[-1].weight.normal_(generator=torch.Generator().manual_seed(seed + 1))
    return network


def some_features(seed: int) -> torch.Tensor:
    return torch.randn(2, FEATURES, 9, 14, generator=torch.Generator().manual_seed(seed))


@torch.no_grad()
def test_a_turned_sensor_gets_the_turned_answer() -> None:
    network, features = drawn(0), some_features(2)
    here, turned = network(features), network(features.roll(5, dims=3))
    for name in ("hit_logit", "intensity_logit"):
        expected = getattr(here, name).roll(5, dims=-1)
        torch.testing.assert_close(getattr(turned, name), expected, rtol=1e-5, atol=1e-5)
    assert here.hit_logit.std() > 0.1


@torch.no_grad()
def test_before_training_nothing_is_corrected() -> None:
    network = PanoNetwork(PanoSpec(), torch.Generator().manual_seed(0))
    correction = network(some_features(3))
    assert not correction.hit_logit.any() and not correction.intensity_logit.any()


def test_it_is_small_and_the_seed_decides_it() -> None:
    first, again, other = (PanoNetwork(PanoSpec(), torch.Generator().manual_seed(s)) for s in (0, 0, 1))
    assert sum(p.numel() for p in first.parameters()) < 16_000
    assert torch.equal(first.layers[0].weight, again.layers[0].weight)
    assert not torch.equal(first.layers[0].weight, other.layers[0].weight)
