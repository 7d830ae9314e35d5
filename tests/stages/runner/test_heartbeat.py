"""Who waits for a stage hears from it, also from one that reports nothing."""

import time

import pytest

from nvsf_core.stages.runner.heartbeat import heartbeat


def test_silence_is_broken_again_and_again():
    said: list[str] = []
    with heartbeat(said.append, "[tiny] evidence", silence_s=0.05):
        time.sleep(0.4)
    assert len(said) >= 3
    assert all(line.startswith("[tiny] evidence: at work for") for line in said)


def test_a_talking_stage_is_left_alone():
    said: list[str] = []
    with heartbeat(said.append, "[tiny] field", silence_s=0.5) as say:
        for step in range(5):
            say(f"step {step}")
            time.sleep(0.02)
    assert said == [f"step {step}" for step in range(5)]


def test_it_ends_with_the_stage_even_when_that_fails():
    said: list[str] = []
    with pytest.raises(ValueError, match="broken"), heartbeat(said.append, "[tiny] pano", silence_s=0.02):
        raise ValueError("broken")
    count = len(said)
    time.sleep(0.1)
    assert len(said) == count
