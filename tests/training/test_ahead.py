"""What is prepared ahead is what would have been prepared when it is taken."""

from threading import Event

import pytest

from nvsf_core.errors import DataError
from nvsf_core.thread_count import VARIABLE
from nvsf_core.training.ahead import Ahead


@pytest.mark.parametrize("threads", ["1", "4"])
def test_each_step_gets_its_own_input(threads, monkeypatch):
    monkeypatch.setenv(VARIABLE, threads)
    with Ahead(lambda step: [step, step**2]) as ahead:
        for step in range(30):
            assert ahead.take(step) == [step, step**2]


def test_later_steps_are_prepared_before_they_are_taken():
    later = Event()
    with Ahead(lambda step: later.set() if step > 0 else None) as ahead:
        ahead.take(0)
        assert later.wait(20.0)


def test_a_repeated_step_and_one_from_a_checkpoint_get_their_own():
    with Ahead(lambda step: 10 * step) as ahead:
        assert [ahead.take(step) for step in (0, 1, 1, 2, 3, 40, 41, 2)] == [0, 10, 10, 20, 30, 400, 410, 20]


def test_an_error_of_a_preparation_is_the_steps():
    def fail(step):
        raise DataError("expected rays, found none")

    with Ahead(fail) as ahead, pytest.raises(DataError, match="found none"):
        ahead.take(0)
