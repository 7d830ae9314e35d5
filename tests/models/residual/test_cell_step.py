"""Laws of learning over a turn's cells."""

import torch

from nvsf_core.fields.layers import CellNetwork
from nvsf_core.models.residual.cell_step import CellExample, cell_step
from nvsf_core.recipe.residual import LossWeights, PanoSpec, TrainingSpec
from nvsf_core.training.loop import make_optimiser

FEATURES = 5
TRAINING = TrainingSpec(steps=150, rays=320, network_rate=3e-2)
SHAPE = (8, 40)


def example(seed: int) -> CellExample:
    """The first feature tells hits, the second intensity."""
    generator = torch.Generator().manual_seed(seed)
    features = torch.randn(FEATURES, *SHAPE, generator=generator)
    returned = features[0] > 0
    return CellExample(
        features=features, hit_logit=torch.zeros(SHAPE), intensity_logit=torch.zeros(SHAPE),
        weight=torch.ones(SHAPE), returned=returned, true_intensity=torch.sigmoid(features[1]),
    )  # fmt: skip


def untrained(outputs: int = 2) -> CellNetwork:
    return CellNetwork(FEATURES, outputs, PanoSpec(channels=6, layers=1), torch.Generator().manual_seed(0))


def learned(seed: int, outputs: int = 2) -> CellNetwork:
    network = untrained(outputs)
    optimiser = make_optimiser(network, TRAINING)
    generator = torch.Generator().manual_seed(seed)
    panos = [example(number) for number in range(8)]
    for _ in range(TRAINING.steps):
        optimiser.zero_grad()
        cell_step(network, panos, TRAINING, LossWeights(), generator).total.backward()
        optimiser.step()
    return network


def test_hits_and_intensity_are_learned() -> None:
    network, unseen = learned(0), example(99)
    with torch.no_grad():
        hit_logit, intensity_logit = network(unseen.features[None])[0]
    returned = unseen.returned
    assert ((hit_logit > 0) == returned).float().mean() > 0.85
    error = (torch.sigmoid(intensity_logit) - unseen.true_intensity)[returned].square().mean()
    assert error < 0.3 * (0.5 - unseen.true_intensity)[returned].square().mean()


def test_a_strip_may_reach_over_the_seam() -> None:
    whole = TrainingSpec(steps=1, rays=8 * 40, parts=1)
    network = untrained()
    with torch.no_grad():
        network.layers[-1].weight.normal_(generator=torch.Generator().manual_seed(1))
    # A strip as wide as the pano is the pano turned: its loss does not depend on where it is cut.
    cuts = (torch.Generator().manual_seed(seed) for seed in range(3))
    losses = [
        cell_step(network, [example(3)], whole, LossWeights(), cut).total.detach().item() for cut in cuts
    ]
    assert max(losses) - min(losses) < 1e-5 * abs(losses[0])


def test_an_empty_pano_teaches_hits_only() -> None:
    empty = example(4)
    empty.returned.zero_()
    loss = cell_step(untrained(), [empty], TRAINING, LossWeights(), torch.Generator().manual_seed(0))
    assert set(loss.terms) == {"hit"}


def test_a_network_of_one_output_learns_hits_alone() -> None:
    network, unseen = learned(0, outputs=1), example(99)
    with torch.no_grad():
        hit_logit = network(unseen.features[None])[0, 0]
    assert ((hit_logit > 0) == unseen.returned).float().mean() > 0.85


def test_cells_that_weigh_nothing_teach_nothing() -> None:
    shown, hidden = example(5), example(5)
    for one in (shown, hidden):
        one.weight[:, ::2] = 0.0
    hidden.returned[:, ::2] = ~hidden.returned[:, ::2]
    drawn = [torch.Generator().manual_seed(0) for _ in range(2)]
    losses = [
        cell_step(untrained(1), [one], TRAINING, LossWeights(), seed).total
        for one, seed in zip((shown, hidden), drawn, strict=True)
    ]
    assert losses[0] == losses[1]
