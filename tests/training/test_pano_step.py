"""Laws of learning over a pano's cells."""

import torch

from nvsf_core.fields.pano_network import FEATURES, PanoNetwork
from nvsf_core.recipe import LossWeights, PanoSpec, TrainingSpec
from nvsf_core.training.loop import make_optimiser
from nvsf_core.training.pano_step import PanoExample, pano_step

SPEC = PanoSpec(channels=6, layers=1, training=TrainingSpec(steps=150, rays=320, network_rate=3e-2))
SHAPE = (8, 40)


def example(seed: int) -> PanoExample:
    """The first feature tells hits, the second intensity."""
    generator = torch.Generator().manual_seed(seed)
    features = torch.randn(FEATURES, *SHAPE, generator=generator)
    returned = features[0] > 0
    return PanoExample(
        features=features, hit_logit=torch.zeros(SHAPE), intensity_logit=torch.zeros(SHAPE),
        range_m=torch.full(SHAPE, 8.0), true_range_m=returned * 8.0,
        true_intensity=torch.sigmoid(features[1]),
    )  # fmt: skip


def learned(seed: int) -> PanoNetwork:
    network = PanoNetwork(SPEC, torch.Generator().manual_seed(seed))
    optimiser = make_optimiser(network, SPEC.training)
    generator = torch.Generator().manual_seed(seed)
    panos = [example(number) for number in range(8)]
    for _ in range(SPEC.training.steps):
        optimiser.zero_grad()
        pano_step(network, panos, SPEC, LossWeights(), generator).total.backward()
        optimiser.step()
    return network


def test_hits_and_intensity_are_learned() -> None:
    network, unseen = learned(0), example(99)
    with torch.no_grad():
        found = network(unseen.features[None])
    returned = unseen.true_range_m > 0
    assert ((found.hit_logit[0] > 0) == returned).float().mean() > 0.85
    error = (torch.sigmoid(found.intensity_logit[0]) - unseen.true_intensity)[returned].square().mean()
    assert error < 0.3 * (0.5 - unseen.true_intensity)[returned].square().mean()


def test_a_strip_may_reach_over_the_seam() -> None:
    whole = PanoSpec(channels=6, layers=1, training=TrainingSpec(steps=1, rays=8 * 40))
    network = PanoNetwork(whole, torch.Generator().manual_seed(0))
    with torch.no_grad():
        network.layers[-1].weight.normal_(generator=torch.Generator().manual_seed(1))
    # A strip as wide as the pano is the pano turned: its loss does not depend on where it is cut.
    cuts = (torch.Generator().manual_seed(seed) for seed in range(3))
    losses = [
        pano_step(network, [example(3)], whole, LossWeights(), cut).total.detach().item() for cut in cuts
    ]
    assert max(losses) - min(losses) < 1e-5 * abs(losses[0])


def test_an_empty_pano_teaches_hits_only() -> None:
    empty = example(4)
    empty.true_range_m.zero_()
    network = PanoNetwork(SPEC, torch.Generator().manual_seed(0))
    loss = pano_step(network, [empty], SPEC, LossWeights(), torch.Generator().manual_seed(0))
    assert set(loss.terms) == {"hit"}
