"""Laws of asking a recorded turn about points: who looks there, and what it recorded of them."""

import numpy as np
import pytest

from nvsf_core.kernels.scan_lookup import (
    BESIDE,
    EMPTY,
    SAME,
    SHINE,
    THROUGH,
    Lasers,
    SweepGrid,
    look_up_scans,
)
from nvsf_core.sensors.sweep import Trajectory, sweep_rays
from nvsf_core.sensors.tables import HDL_64E

FIRINGS, MOMENTS, PERIOD_S = 360, 256, 0.1
ROWS = np.arange(64)


def trajectory(speed_m_s: float) -> Trajectory:
    """Straight ahead, turning a little."""
    times = np.arange(5) * PERIOD_S
    poses = np.tile(np.eye(4), (5, 1, 1))
    cosine, sine = np.cos(0.2 * times), np.sin(0.2 * times)
    poses[:, 0, 0], poses[:, 0, 1], poses[:, 1, 0], poses[:, 1, 1] = cosine, -sine, sine, cosine
    poses[:, 0, 3] = speed_m_s * times
    return Trajectory(times, poses, np.eye(4))


def recorded(speed_m_s: float) -> tuple[np.ndarray, Lasers, SweepGrid]:
    """Points (l * f, 3) along a turn's own rays, and the turn that recorded each."""
    path, time_s = trajectory(speed_m_s), 0.2
    rays = sweep_rays(HDL_64E, ROWS, FIRINGS, path, time_s, PERIOD_S)
    rng = np.random.default_rng(0)
    range_m = rng.uniform(4.0, 60.0, FIRINGS * len(ROWS)).astype(np.float32)
    points_m = rays.origin_m + rays.direction * range_m[:, None]
    shift_rad = (HDL_64E.phase_steps - HDL_64E.firing_shift_steps) * HDL_64E.step_rad
    up_m = HDL_64E.vertical_offset_m
    # Picked by row, as of a recording: for a table's read-only arrays the kernel would be compiled once more.
    lasers = Lasers(
        ROWS, HDL_64E.elevation_rad[ROWS], up_m[ROWS], up_m / np.cos(HDL_64E.elevation_rad),
        HDL_64E.horizontal_offset_m[ROWS], shift_rad, HDL_64E.elevation_correction_rad,
    )  # fmt: skip
    rotation, position = path.at(time_s + ((np.arange(MOMENTS) + 0.5) / MOMENTS - 0.5) * PERIOD_S)
    shine = rng.uniform(0.0, 1.0, (len(ROWS), FIRINGS)).astype(np.float32)
    fraction = rays.fraction[:FIRINGS].astype(np.float32)
    return points_m, lasers, SweepGrid(rotation, position, fraction, range_m.reshape(-1, FIRINGS), shine)


def asked(points_m: np.ndarray, lasers: Lasers, sweep: SweepGrid) -> np.ndarray:
    found = np.zeros((len(points_m), 5), np.float32)
    look_up_scans(points_m, lasers, sweep, found)
    return found


@pytest.mark.parametrize("speed_m_s", [0.0, 12.0])
def test_a_turn_saw_its_own_returns(speed_m_s: float) -> None:
    points_m, lasers, sweep = recorded(speed_m_s)
    found = asked(points_m, lasers, sweep)
    assert found[:, SAME].mean() > 0.995
    seen = found[:, SAME] > 0
    assert (found[seen, SHINE] == sweep.intensity.reshape(-1)[seen]).mean() > 0.995
    assert not found[:, EMPTY].any()


def test_nothing_recorded_is_empty_and_what_lies_behind_was_seen_through_to() -> None:
    points_m, lasers, sweep = recorded(5.0)
    nothing = asked(points_m, lasers, sweep._replace(range_m=np.zeros_like(sweep.range_m)))
    assert nothing[:, EMPTY].mean() > 0.995 and not nothing[:, (SAME, THROUGH, BESIDE, SHINE)].any()
    behind = asked(points_m, lasers, sweep._replace(range_m=2.0 * sweep.range_m))
    assert behind[:, THROUGH].mean() > 0.99 and not behind[:, (EMPTY, SHINE)].any()
    hidden = asked(points_m, lasers, sweep._replace(range_m=0.5 * sweep.range_m))
    assert not hidden[:, (SAME, THROUGH, EMPTY)].any() and (hidden[:, BESIDE] > 0.99).mean() > 0.99


def test_a_firing_counts_twice_as_much_as_those_beside_it() -> None:
    points_m, lasers, sweep = recorded(0.0)
    every_second = sweep.range_m.copy()
    every_second[:, ::2] = 0.0
    beside = asked(points_m, lasers, sweep._replace(range_m=every_second))[:, BESIDE]
    # The half turn's seam has a neighbour on one side alone.
    assert np.isclose(beside, 0.5).mean() > 0.98


def test_points_that_nobody_looked_at_say_nothing_and_answers_add_up() -> None:
    points_m, lasers, sweep = recorded(0.0)
    rest = np.array([[np.inf, 0.0, 0.0], [np.nan, 1.0, 0.0], [5.0, 0.0, 20.0], [0.0, 0.0, 0.0]], np.float32)
    assert not asked(rest, lasers, sweep).any()
    found = asked(points_m, lasers, sweep)
    twice = found.copy()
    look_up_scans(points_m, lasers, sweep, twice)
    assert np.array_equal(twice, 2.0 * found)
