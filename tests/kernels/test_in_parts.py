"""How work is divided among threads."""

import threading

import numba
import pytest
import torch

from nvsf_core.errors import RecipeError
from nvsf_core.kernels.threads import in_parts, use_threads
from nvsf_core.thread_count import VARIABLE, thread_count


@pytest.mark.parametrize("threads", ["1", "3"])
def test_results_come_in_order_and_each_part_has_one_thread_of_torch_and_of_our_kernels(threads, monkeypatch):
    monkeypatch.setenv(VARIABLE, threads)
    use_threads()
    found = in_parts(lambda part: (part, torch.get_num_threads()), 7)
    assert found == [(part, 1) for part in range(7)]
    if threads != "1":
        assert in_parts(lambda _: numba.get_num_threads(), 3) == [1, 1, 1]


def test_as_many_parts_at_once_as_there_are_threads_but_no_more_than_asked(monkeypatch):
    monkeypatch.setenv(VARIABLE, "4")
    together = threading.Barrier(4, timeout=20.0)
    in_parts(lambda _: together.wait(), 4)
    running, most, lock = 0, 0, threading.Lock()

    def one(_: int) -> None:
        nonlocal running, most
        with lock:
            running += 1
            most = max(most, running)
        threading.Event().wait(0.01)
        with lock:
            running -= 1

    in_parts(one, 8, at_once=2)
    assert most == 2


def test_parts_of_a_part_do_not_wait_for_each_other(monkeypatch):
    monkeypatch.setenv(VARIABLE, "2")
    assert in_parts(lambda part: in_parts(lambda own: (part, own), 3), 4) == [
        [(part, own) for own in range(3)] for part in range(4)
    ]


def test_parts_have_the_callers_choice_of_gradients(monkeypatch):
    monkeypatch.setenv(VARIABLE, "2")
    with torch.no_grad():
        assert in_parts(lambda _: torch.is_grad_enabled(), 3) == [False] * 3
    assert in_parts(lambda _: torch.is_grad_enabled(), 3) == [True] * 3


def test_an_error_of_a_part_is_raised(monkeypatch):
    monkeypatch.setenv(VARIABLE, "2")
    with pytest.raises(ZeroDivisionError):
        in_parts(lambda part: 1 // (part - 2), 4)


@pytest.mark.parametrize("wrong", ["0", "-1", "two", "1.5"])
def test_a_wrong_number_of_threads_is_refused(wrong, monkeypatch):
    monkeypatch.setenv(VARIABLE, wrong)
    with pytest.raises(RecipeError, match=f"NVSF_THREADS='{wrong}': expected a whole number"):
        thread_count()


def test_all_cores_of_the_process_by_default(monkeypatch):
    monkeypatch.delenv(VARIABLE)
    assert thread_count() >= 1
