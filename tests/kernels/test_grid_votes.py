"""Laws of reading a sensor's grid between its cells."""

import numpy as np

from nvsf_core.kernels.grid_votes import read_grid

ELEVATION = np.deg2rad(np.array([2.0, 1.0, 0.0, -1.0]))
FIRINGS = 360
FRACTION = (np.arange(FIRINGS) + 0.5) / FIRINGS - 0.5
NONE = np.zeros(4)


def read(azimuth_rad: np.ndarray, elevation_rad: np.ndarray, is_hit: np.ndarray, offset_m=NONE) -> np.ndarray:
    range_m = np.full(len(azimuth_rad), 10.0)
    return read_grid(
        azimuth_rad, elevation_rad, range_m * np.cos(elevation_rad), range_m, np.arange(4), ELEVATION, NONE,
        offset_m, NONE, FRACTION, is_hit,
    )  # fmt: skip


def test_a_place_on_a_firing_reads_that_firing_alone() -> None:
    rng = np.random.default_rng(0)
    is_hit = rng.random((4, FIRINGS)) < 0.5
    laser, firing = np.meshgrid(np.arange(4), np.arange(FIRINGS), indexing="ij")
    found = read(-2.0 * np.pi * FRACTION[firing.ravel()], ELEVATION[laser.ravel()], is_hit)
    assert np.allclose(found, is_hit.ravel(), atol=1e-6)


def test_between_two_lasers_and_two_firings_it_is_linear() -> None:
    is_hit = np.zeros((4, FIRINGS), bool)
    is_hit[1, 100] = True
    across, down = np.meshgrid(np.linspace(0.0, 1.0, 5), np.linspace(0.0, 1.0, 7))
    azimuth = -2.0 * np.pi * (FRACTION[100] + across.ravel() / FIRINGS)
    found = read(azimuth, ELEVATION[1] - np.deg2rad(down.ravel()), is_hit)
    assert np.allclose(found, ((1.0 - across) * (1.0 - down)).ravel(), atol=1e-6)


def test_beyond_the_outermost_lasers_these_answer() -> None:
    is_hit = np.zeros((4, FIRINGS), bool)
    is_hit[0] = True
    assert np.array_equal(read(np.zeros(2), np.deg2rad(np.array([9.0, -9.0])), is_hit), [1.0, 0.0])


def test_a_laser_beside_the_axis_looks_past_it() -> None:
    is_hit = np.zeros((4, FIRINGS), bool)
    is_hit[:, 180:] = True
    offset_m = np.full(4, 0.1)
    edge = -2.0 * np.pi * 0.5 * (FRACTION[179] + FRACTION[180])
    azimuth = edge + np.array([-0.03, 0.03])
    assert np.array_equal(read(azimuth, np.zeros(2), is_hit), [1.0, 0.0])
    beside = azimuth + np.arcsin(0.1 / 10.0)
    assert np.array_equal(read(beside, np.zeros(2), is_hit, offset_m), [1.0, 0.0])
