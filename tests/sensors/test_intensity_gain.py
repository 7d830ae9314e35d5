"""Laws of the lasers' intensity gains, on surfaces whose brightness is known."""

import numpy as np

from nvsf_core.sensors.sensor_errors import learn_intensity_gain

GAIN = np.array([0.8, 1.2, 1.0, 1.0])


def returns(gain: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of a floor of bright and dark tiles, seen by all lasers, some of an unknown one."""
    rng = np.random.default_rng(0)
    points = rng.uniform((0, 0, 0), (8, 8, 0.01), (40_000, 3))
    bright = np.where((points[:, :2] // 0.6).sum(axis=1) % 2 == 0, 0.2, 0.5)
    laser = rng.integers(-1, 4, len(points)).astype(np.int16)
    shine = bright * np.append(gain, 3.0)[laser] + rng.normal(0, 0.02, len(points))
    return points, np.clip(shine, 0, 1), laser


def test_gains_are_found_within_a_per_cent_and_average_to_one() -> None:
    found = learn_intensity_gain(*returns(GAIN), 4)
    assert np.abs(found - GAIN).max() < 0.015
    assert abs(found.mean() - 1.0) < 1e-9


def test_lasers_that_agree_or_see_nothing_are_left_alone() -> None:
    assert (learn_intensity_gain(*returns(np.ones(4)), 4) == 1.0).all()
    points, shine, laser = returns(GAIN)
    assert (learn_intensity_gain(points, shine, np.full_like(laser, -1), 4) == 1.0).all()
