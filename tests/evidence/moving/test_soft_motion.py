"""Laws of flow: surfaces that move across themselves, and what is carried from scan to scan."""

import numpy as np
import pytest

from nvsf_core.evidence.moving.soft_motion import carried, flow_between, flow_to


def sheet(x_m: float, count: int, seed: int) -> np.ndarray:
    """A plate of 1 x 1 m across x."""
    y, z = np.random.default_rng(seed).uniform(-0.5, 0.5, (2, count))
    return np.column_stack([np.full(count, x_m), y, z]).astype(np.float32)


@pytest.mark.parametrize("count", [300, 3000], ids=["whole", "thinned"])
def test_a_sheet_flows_onto_where_it_is_seen_next(count: int) -> None:
    flow = flow_between(sheet(0.0, count, 0), sheet(0.2, count, 1))
    assert flow.dtype == np.float32 and flow.shape == (count, 3)
    np.testing.assert_allclose(flow[:, 0], 0.2, atol=0.01)
    assert np.abs(flow[:, 1:]).max() < 0.01, "along the sheet nothing is known to move"


def test_two_halves_flow_two_ways() -> None:
    ahead, up = np.array([0.15, 0.0, 0.0]), np.array([0.0, 0.0, 0.8])
    low, high = sheet(0.0, 300, 0) - up, sheet(0.0, 300, 1) + up
    flow = flow_between(np.concatenate([low, high]), np.concatenate([low + ahead, high - ahead]))
    np.testing.assert_allclose(flow[:300, 0], 0.15, atol=0.02)
    np.testing.assert_allclose(flow[300:, 0], -0.15, atol=0.02)


@pytest.mark.parametrize(("source", "target"), [(0, 300), (7, 300), (300, 7), (300, 0)])
def test_nothing_flows_where_too_little_was_seen(source: int, target: int) -> None:
    flow = flow_between(sheet(0.0, source, 0), sheet(0.2, target, 1))
    np.testing.assert_array_equal(flow, np.zeros((source, 3), np.float32))


def test_scans_about_an_instant_meet_there_and_those_beyond_follow() -> None:
    """A sheet that moves 0.1 m a scan lies, at any instant between, at one place as all four show it."""
    clouds = [sheet(0.1 * number, 200, number) for number in range(4)]
    instants = 0.1 * np.arange(4)
    for time_s in (0.11, 0.15, 0.19):
        moved = flow_to(clouds, instants, time_s, lambda a, b: flow_between(clouds[a], clouds[b]))
        for cloud, flow in zip(clouds, moved, strict=True):
            np.testing.assert_allclose(cloud[:, 0] + flow[:, 0], time_s, atol=0.01)


@pytest.mark.parametrize(("time_s", "shown_m"), [(-0.1, 0.0), (0.0, 0.0), (0.3, 0.3), (0.45, 0.3)])
def test_beyond_the_first_and_the_last_scan_what_they_saw_stays(time_s: float, shown_m: float) -> None:
    clouds = [sheet(0.1 * number, 200, number) for number in range(4)]
    moved = flow_to(clouds, 0.1 * np.arange(4), time_s, lambda a, b: flow_between(clouds[a], clouds[b]))
    for cloud, flow in zip(clouds, moved, strict=True):
        np.testing.assert_allclose(cloud[:, 0] + flow[:, 0], shown_m, atol=0.01)


def test_one_scan_alone_does_not_move() -> None:
    (flow,) = flow_to([sheet(0.0, 20, 0)], np.zeros(1), 0.05, lambda a, b: np.full((20, 3), np.nan))
    np.testing.assert_array_equal(flow, np.zeros((20, 3), np.float32))


def test_what_is_carried_is_near_ones_mean_and_a_lone_ones_own() -> None:
    known, flow = np.array([[0.0, 0, 0], [1.0, 0, 0]]), np.array([[1.0, 0, 0], [3.0, 0, 0]])
    found = carried(np.array([[0.0, 0, 0], [0.5, 0, 0]]), known, flow)
    np.testing.assert_allclose(found[:, 0], [1.0, 2.0], atol=1e-2)
    np.testing.assert_allclose(carried(known, known[:1], flow[:1]), np.tile(flow[:1], (2, 1)))
