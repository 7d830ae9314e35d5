"""The clock of a sensor is found from its returns' times, wherever it is cut and whichever way it spins."""

import numpy as np
import pytest

from nvsf_core.sensors.scan_timing import scan_timing
from nvsf_core.sensors.sweep_clock import SweepClock, find_clock, sweep_duration_s
from nvsf_core.sensors.tables import VLP_16

CLOCKS = [
    SweepClock(), SweepClock(cut=0.0, lag=-0.5), SweepClock(cut=0.25, lag=-0.75), SweepClock(spin=-1.0),
    SweepClock(spin=-1.0, cut=-0.1, lag=-0.4), SweepClock(cut=0.3, lag=0.1),
]  # fmt: skip


@pytest.mark.parametrize("clock", CLOCKS)
def test_the_clock_of_a_sweep_is_found(clock: SweepClock) -> None:
    rng = np.random.default_rng(0)
    fraction = rng.uniform(-0.5, 0.5, 20_000)
    elapsed = clock.elapsed(fraction)
    # One sweep, no more: cut to cut.
    assert np.isclose(elapsed.min(), clock.cut + clock.lag, atol=1e-3) and np.ptp(elapsed) <= 1.0
    found = find_clock(fraction, elapsed + rng.normal(0.0, 1e-3, len(elapsed)))
    assert found is not None and found.spin == clock.spin
    assert (np.abs(found.elapsed(fraction) - elapsed) > 0.01).mean() < 0.01


def test_the_usual_clock_changes_no_bit() -> None:
    fraction = np.random.default_rng(0).uniform(-0.5, 0.5, 1000)
    for kind in (np.float32, np.float64):
        assert np.array_equal(SweepClock().elapsed(fraction.astype(kind)), fraction.astype(kind))


def test_times_that_do_not_follow_the_azimuth_have_no_clock_and_are_counted() -> None:
    rng = np.random.default_rng(0)
    azimuth = rng.uniform(-np.pi, np.pi, 4000)
    points = np.stack([10.0 * np.cos(azimuth), 10.0 * np.sin(azimuth), np.zeros(4000)], axis=1)
    elapsed = rng.uniform(-0.5, 0.5, 4000)
    assert find_clock(-azimuth / (2.0 * np.pi), elapsed) is None
    assert find_clock(elapsed[:0], elapsed[:0]) is None
    timing = scan_timing(points, VLP_16, offset_s=0.1 * elapsed, period_s=0.1)
    assert timing.clock == SweepClock() and np.allclose(timing.elapsed, elapsed)
    assert timing.share_beside_clock > 0.5 and "do not follow the azimuth" in timing.evidence


@pytest.mark.parametrize("clock", CLOCKS)
def test_the_duration_of_a_sweep_of_key_frames_is_found_from_its_times(clock: SweepClock) -> None:
    rng = np.random.default_rng(0)
    fraction = rng.uniform(-0.5, 0.5, 20_000)
    for period_s, step_s in ((0.05, 0.5), (0.1, 0.2), (0.1, 1.0)):
        offset_s = period_s * clock.elapsed(fraction) + rng.normal(0.0, 1e-4, len(fraction))
        assert sweep_duration_s(fraction, offset_s, step_s) == pytest.approx(period_s, rel=1e-3)
    # Frames that follow each other are a sweep apart, also where a part of it was kept.
    for kept in (fraction < 2.0, np.abs(fraction) < 0.1):
        assert sweep_duration_s(fraction[kept], 0.1 * clock.elapsed(fraction)[kept], 0.1042) == 0.1042


@pytest.mark.parametrize("clock", CLOCKS)
def test_lasers_that_look_aside_of_the_azimuth_shorten_no_sweep(clock: SweepClock) -> None:
    rng = np.random.default_rng(0)
    fired = rng.uniform(-0.5, 0.5, 20_000)
    offset_s = 0.1 * clock.elapsed(fired)
    # Up to 9 degrees, as those of an HDL-64E.
    seen = np.mod(fired + rng.choice([-0.025, 0.0, 0.025], len(fired)) + 0.5, 1.0) - 0.5
    assert sweep_duration_s(seen, offset_s, 0.3) == pytest.approx(0.1, rel=2e-3)


def test_times_that_do_not_follow_the_azimuth_tell_no_duration() -> None:
    rng = np.random.default_rng(0)
    fraction = rng.uniform(-0.5, 0.5, 4000)
    assert sweep_duration_s(fraction, np.zeros(4000), 0.5) is None
    assert sweep_duration_s(fraction, rng.uniform(0.0, 0.1, 4000), 0.5) is None
    assert sweep_duration_s(fraction[:0], fraction[:0], 0.5) is None
