"""Laws of the averaged weights."""

import pytest
import torch
from torch import nn

from nvsf_core.errors import StoreError
from nvsf_core.training.weight_average import WeightAverage


def model_at(value: float) -> nn.Linear:
    model = nn.Linear(1, 1, bias=False)
    with torch.no_grad():
        model.weight.fill_(value)
    return model


def test_the_first_updates_follow_closely_then_the_decay_holds() -> None:
    model = model_at(0.0)
    average = WeightAverage(model, 0.95)
    expected = 0.0
    for k in range(1, 400):
        with torch.no_grad():
            model.weight.fill_(float(k))
        average.update()
        decay = min(0.95, (1 + k) / (10 + k))
        expected = decay * expected + (1 - decay) * k
        if k == 1:
            assert expected == pytest.approx(9 / 11)
    with average.in_place():
        assert model.weight.item() == pytest.approx(expected, rel=1e-5)
    assert model.weight.item() == 399.0


def test_without_a_decay_all_updates_count_alike() -> None:
    model = model_at(0.0)
    average = WeightAverage(model, None)
    for value in (3.0, 5.0, 13.0):
        with torch.no_grad():
            model.weight.fill_(value)
        average.update()
    average.put_in_place()
    assert model.weight.item() == pytest.approx(7.0, rel=1e-6)


def test_the_models_own_weights_come_back_after_an_error() -> None:
    model = model_at(1.0)
    average = WeightAverage(model, 0.95)
    with torch.no_grad():
        model.weight.fill_(3.0)
    average.update()
    with pytest.raises(RuntimeError), average.in_place():
        assert model.weight.item() != 3.0
        raise RuntimeError
    assert model.weight.item() == 3.0


@pytest.mark.parametrize(("decay", "updates"), [(0.0, 3), (0.95, 0)])
def test_without_an_average_the_model_keeps_its_weights(decay: float, updates: int) -> None:
    model = model_at(2.0)
    average = WeightAverage(model, decay)
    for _ in range(updates):
        average.update()
    with torch.no_grad():
        model.weight.fill_(5.0)
    with average.in_place():
        assert model.weight.item() == 5.0


def test_it_is_restored_and_goes_on_alike() -> None:
    model, other = model_at(1.0), model_at(7.0)
    average, restored = WeightAverage(model, 0.95), WeightAverage(other, 0.95)
    average.update()
    restored.restore(average.tensors())
    for m in (model, other):
        with torch.no_grad():
            m.weight.fill_(4.0)
    average.update()
    restored.update()
    assert torch.equal(average.tensors()["ema.weight"], restored.tensors()["ema.weight"])
    with pytest.raises(StoreError, match="weight"):
        WeightAverage(nn.Linear(2, 2, bias=False), 0.9).restore(average.tensors())


def test_training_goes_on_unchanged_after_an_evaluation() -> None:
    weights = []
    for evaluate in (False, True):
        model = model_at(1.0)
        optimiser = torch.optim.Adam(model.parameters(), lr=0.1)
        average = WeightAverage(model, 0.5)
        for _ in range(5):
            optimiser.zero_grad()
            (model(torch.ones(1, 1)) ** 2).sum().backward()
            optimiser.step()
            average.update()
            if evaluate:
                with average.in_place():
                    model(torch.ones(1, 1))
        weights.append(model.weight.item())
    assert weights[0] == weights[1]
