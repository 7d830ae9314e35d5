"""Laws of what is measured again and again where the sensor stands or crawls."""

from dataclasses import replace

import numpy as np

from nvsf_core.evidence.drop_prior import DropPrior
from nvsf_core.evidence.stationary_scans import (
    FiredRays,
    StationaryScans,
    find_stationary_scans,
    look_up_stationary,
)
from nvsf_core.geometry.se3 import pose_from_parts
from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.sensors.sweep_clock import SweepClock

FRAME_S, FRAMES, HELD_OUT, FIRINGS = 0.1, 9, 4, 100
TRAINING = np.array([frame for frame in range(FRAMES) if frame != HELD_OUT])
FRACTION = ((np.arange(FIRINGS) + 0.5) / FIRINGS - 0.5).astype(np.float32)


def driving(speed_m_s: float) -> Trajectory:
    time_s = np.arange(FRAMES) * FRAME_S
    place = np.stack([speed_m_s * time_s, np.zeros(FRAMES), np.zeros(FRAMES)], axis=1)
    return Trajectory(time_s, pose_from_parts(np.eye(3)[None].repeat(FRAMES, 0), place), np.eye(4))


def measured(range_m: np.ndarray) -> tuple[StationaryScans, DropPrior]:
    """One laser; every firing of training scan k measured range_m[k], 0 = no return."""
    count = len(TRAINING)
    ranges = np.broadcast_to(range_m[:, None, None], (count, 1, FIRINGS)).astype(np.float32)
    prior = DropPrior(TRAINING * FRAME_S, np.tile(FRACTION, (count, 1)), ranges > 0)
    return StationaryScans(
        np.arange(count, dtype=np.int32), ranges.copy(), np.full_like(ranges, 0.5), np.array(False)
    ), prior


def surfaces(range_m: float, hit: float = 1.0) -> FiredRays:
    """What surfaces answer to every firing of the one laser."""
    ones = np.ones(FIRINGS, np.float32)
    return FiredRays(np.zeros(FIRINGS, np.int64), FRACTION, range_m * ones, hit * ones, 0.2 * ones)


def answer(range_m: np.ndarray, rays: FiredRays, *, speed_m_s: float = 0.0, leave_out: int | None = None):
    trajectory = driving(speed_m_s)
    stationary, prior = measured(range_m)
    return look_up_stationary(
        stationary, prior, rays, HELD_OUT * FRAME_S, trajectory, FRAME_S, leave_out=leave_out
    )


def test_only_scans_that_were_taken_where_another_frame_was_are_kept() -> None:
    time_s = TRAINING * FRAME_S
    assert len(find_stationary_scans(time_s, driving(9.0))) == 0
    assert len(find_stationary_scans(time_s, driving(0.3))) == len(TRAINING)
    stops = driving(9.0)
    poses = stops.lidar_to_world.copy()
    poses[5:, 0, 3] = poses[5, 0, 3]
    halted = find_stationary_scans(time_s, Trajectory(stops.times_s, poses, np.eye(4)))
    assert TRAINING[halted].tolist() == [5, 6, 7, 8]


def test_a_standing_sensor_answers_what_it_measured_and_not_what_surfaces_say() -> None:
    noise = np.random.default_rng(0).normal(0.0, 0.015, len(TRAINING))
    range_m, hit, intensity = answer(20.0 + noise, surfaces(24.0, hit=0.3))
    np.testing.assert_allclose(range_m, 20.0, atol=0.02)
    assert hit.min() > 0.7
    np.testing.assert_allclose(intensity, 0.5)


def test_a_crawling_sensor_follows_the_ranges_trend() -> None:
    speed = 0.3
    nearer = 20.0 - speed * FRAME_S * (TRAINING - HELD_OUT)
    # Held out at the end: every scan is before it, and a mean would lag behind.
    range_m, _, _ = answer(nearer, surfaces(20.0), speed_m_s=speed)
    np.testing.assert_allclose(range_m, 20.0, atol=1e-3)
    late = np.where(TRAINING < HELD_OUT, nearer, 0.0)
    range_m, _, _ = answer(late, surfaces(np.inf), speed_m_s=speed)
    assert np.abs(range_m - 20.0).max() < 0.5 * np.abs(late[late > 0] - 20.0).mean()


def test_what_drives_by_is_where_the_scans_beside_saw_it() -> None:
    scans = np.where(np.abs(TRAINING - HELD_OUT) == 1, 8.0, 20.0)
    range_m, hit, _ = answer(scans, surfaces(20.0))
    np.testing.assert_allclose(range_m, 8.0, atol=1e-3)
    assert hit.min() == 1.0


def test_a_place_of_a_moving_thing_that_only_surfaces_know_is_kept() -> None:
    scans = 20.0 + 0.8 * (TRAINING - HELD_OUT)
    range_m, _, _ = answer(scans, surfaces(20.0))
    np.testing.assert_allclose(range_m, 20.0)


def test_beams_that_mostly_do_not_return_are_not_expected_to() -> None:
    scans = np.where(TRAINING % 4 == 3, 20.0, 0.0)
    _, hit, _ = answer(scans, surfaces(20.0, hit=0.25))
    assert hit.max() < 0.5


def test_scans_of_another_place_are_not_asked() -> None:
    rays = surfaces(24.0)
    rendered = answer(np.full(len(TRAINING), 20.0), rays, speed_m_s=9.0)
    for given, kept in zip(rendered, (rays.range_m, rays.hit, rays.intensity), strict=True):
        assert np.array_equal(given, kept)


def test_a_scan_that_is_left_out_is_not_asked() -> None:
    scans = np.zeros(len(TRAINING))
    scans[2] = 20.0
    range_m, _, _ = answer(scans, surfaces(np.inf, hit=0.0))
    np.testing.assert_allclose(range_m, 20.0)
    range_m, hit, _ = answer(scans, surfaces(np.inf, hit=0.0), leave_out=2)
    assert np.isinf(range_m).all() and hit.max() == 0.0


def test_copied_scans_answer_what_the_nearest_one_measured_or_that_it_had_no_return() -> None:
    for nearest_m in (12.0, 0.0):
        range_m = np.full(len(TRAINING), 20.0)
        range_m[np.flatnonzero(TRAINING < HELD_OUT)[-1]] = nearest_m
        stationary, prior = measured(range_m)
        found_m, hit, intensity = look_up_stationary(
            replace(stationary, is_copied=np.array(True)), prior, surfaces(20.0),
            HELD_OUT * FRAME_S, driving(0.0), FRAME_S,
        )  # fmt: skip
        assert (hit == (nearest_m > 0.0)).all()
        if nearest_m > 0.0:
            assert (found_m == nearest_m).all()
            assert (intensity == 0.5).all()


def test_places_are_compared_when_each_of_two_sensors_looked_there() -> None:
    # It stood until the middle of the held-out sweep, and is off, by more than a ray's footprint, in no time.
    poses = driving(300.0).lidar_to_world - driving(300.0).lidar_to_world[HELD_OUT] + np.eye(4)
    poses[:HELD_OUT] = np.eye(4)
    path = Trajectory(np.arange(FRAMES) * FRAME_S, poses, np.eye(4))
    stationary, prior = measured(np.where(TRAINING < HELD_OUT, 20.0, 0.0))
    # Cut in front: what lies behind and to the right is measured in the first half of a sweep.
    clocks = {"behind": SweepClock(), "in front": SweepClock(cut=0.0, lag=-0.5)}
    for name, clock in clocks.items():
        rays = replace(surfaces(24.0), clock=clock)
        found_m, _, _ = look_up_stationary(
            stationary, prior, rays, HELD_OUT * FRAME_S, path, FRAME_S, clocks=[clock] * len(TRAINING)
        )
        elapsed = clock.elapsed(FRACTION.astype(np.float64))
        clear = np.abs(np.abs(elapsed) - 0.25) < 0.15
        expected_m = np.where(elapsed < 0.0, 20.0, 24.0)
        np.testing.assert_allclose(found_m[clear], expected_m[clear], atol=0.02, err_msg=name)


def test_it_comes_back_from_the_store_as_it_went_in() -> None:
    kept, _ = measured(np.full(len(TRAINING), 20.0))
    found = StationaryScans.from_arrays(kept.to_arrays())
    assert found is not None and StationaryScans.from_arrays({}) is None
    for name in StationaryScans.__slots__:
        assert np.array_equal(getattr(found, name), getattr(kept, name)), name
