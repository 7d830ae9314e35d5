"""Examples come once each before any comes again, and the same ones whenever they are asked for."""

import pytest
import torch

from nvsf_core.training.epochs import Epochs


@pytest.mark.parametrize("length", [1, 7, 30, 100, 250])
def test_each_example_comes_once_an_epoch(length):
    epochs = Epochs(100, seed=3)
    sequence = torch.cat([epochs.part(number, length) for number in range(-(-400 // length))])[:400]
    for epoch in sequence.split(100):
        assert torch.equal(epoch.sort().values, torch.arange(100))
    assert not torch.equal(sequence[:100], sequence[100:200])


def test_a_part_does_not_depend_on_what_was_asked_before():
    in_order = [part.tolist() for part in (Epochs(50, seed=1).part(number, 20) for number in range(9))]
    asked = Epochs(50, seed=1)
    for number in (8, 0, 5, 2, 5):
        assert asked.part(number, 20).tolist() == in_order[number]


def test_another_seed_gives_another_order():
    first, second = (Epochs(100, seed=seed).part(0, 100).tolist() for seed in (0, 1))
    assert first != second
