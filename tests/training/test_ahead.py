"""What is prepared ahead is what would have been prepared when it is taken."""

import pytest
import torch

from nvsf_core.errors import DataError
from nvsf_core.thread_count import VARIABLE
from nvsf_core.training.ahead import Ahead
from nvsf_core.training.loop import side_by_side


def _drawn(generators):
    return [torch.rand(3, generator=own).tolist() for own in generators]


def _expected(generator):
    """What the parts of a step draw whose input is not prepared ahead."""
    drawn = []

    def loss(own):
        drawn.append(torch.rand(3, generator=own).tolist())
        raise DataError("expected no more")

    for part in side_by_side(2, generator, loss):
        with pytest.raises(DataError):
            part()
    return drawn


@pytest.mark.parametrize("threads", ["1", "4"])
def test_each_step_gets_what_its_generator_decides(threads, monkeypatch):
    monkeypatch.setenv(VARIABLE, threads)
    generator, same = (torch.Generator().manual_seed(5) for _ in range(2))
    with Ahead(2, _drawn) as ahead:
        for _ in range(30):
            assert ahead.take(generator) == _expected(same)


def test_a_repeated_step_and_one_from_a_checkpoint_get_their_own():
    generator = torch.Generator().manual_seed(5)
    with Ahead(2, _drawn) as ahead:
        before = generator.get_state()
        first, second = ahead.take(generator), ahead.take(generator)
        assert first != second
        generator.set_state(before)
        assert [ahead.take(generator), ahead.take(generator)] == [first, second]
        other = torch.Generator().manual_seed(6)
        assert ahead.take(other) == _expected(torch.Generator().manual_seed(6))


def test_an_error_of_a_preparation_is_the_steps():
    def fail(generators):
        raise DataError("expected rays, found none")

    with Ahead(1, fail) as ahead, pytest.raises(DataError, match="found none"):
        ahead.take(torch.Generator())
