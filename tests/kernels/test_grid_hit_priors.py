"""Laws of reading a sensor's grid between its cells."""

import numpy as np

from nvsf_core.kernels.grid_hit_priors import FiringLasers, share_of_scans

ELEVATION = np.deg2rad(np.array([2.0, 1.0, 0.0, -1.0]))
FIRINGS = 360
FRACTION = (np.arange(FIRINGS) + 0.5) / FIRINGS - 0.5
NONE = np.zeros(4)


def read(azimuth_rad: np.ndarray, elevation_rad: np.ndarray, is_hit: np.ndarray, offset_m=NONE) -> np.ndarray:
    """Shares of one scan at places 10 m from its sensor."""
    return shares(places(azimuth_rad, elevation_rad), np.eye(4)[None], np.ones(1), is_hit[None], offset_m)


def places(azimuth_rad: np.ndarray, elevation_rad: np.ndarray) -> np.ndarray:
    flat_m = 10.0 * np.cos(elevation_rad)
    x_m, y_m = flat_m * np.cos(azimuth_rad), flat_m * np.sin(azimuth_rad)
    return np.column_stack([x_m, y_m, 10.0 * np.sin(elevation_rad)])


def shares(place_m, to_sensor, weights, is_hit, offset_m=NONE, turned_down_rad=0.0) -> np.ndarray:
    scans = np.arange(len(to_sensor))
    # A firing fewer than the grid has columns: behind the last fraction there is none.
    fraction = np.tile(np.append(FRACTION, np.inf).astype(np.float32), (len(scans), 1))
    lasers = FiringLasers(turned_down_rad, np.arange(4), ELEVATION, NONE, offset_m, NONE)
    is_hit = np.pad(is_hit, ((0, 0), (0, 0), (0, 1)), constant_values=True)
    return share_of_scans(place_m, to_sensor, weights, lasers, scans, fraction, is_hit)


def test_a_place_on_a_firing_reads_that_firing_alone() -> None:
    rng = np.random.default_rng(0)
    is_hit = rng.random((4, FIRINGS)) < 0.5
    laser, firing = np.meshgrid(np.arange(4), np.arange(FIRINGS), indexing="ij")
    found = read(-2.0 * np.pi * FRACTION[firing.ravel()], ELEVATION[laser.ravel()], is_hit)
    assert np.allclose(found, is_hit.ravel(), atol=1e-5)


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


def test_scans_count_by_weight_and_each_sees_the_place_from_where_it_was() -> None:
    rng = np.random.default_rng(1)
    azimuth, elevation = rng.uniform(-3.0, 3.0, 50), np.deg2rad(rng.uniform(-1.0, 2.0, 50))
    is_hit = rng.random((2, 4, FIRINGS)) < 0.5
    to_sensor = np.stack([np.eye(4), np.eye(4)])
    to_sensor[1, :3, :3] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    found = shares(places(azimuth, elevation), to_sensor, np.array([3.0, 1.0]), is_hit)
    turned = read((azimuth + 1.5 * np.pi) % (2.0 * np.pi) - np.pi, elevation, is_hit[1])
    assert np.allclose(found, 0.75 * read(azimuth, elevation, is_hit[0]) + 0.25 * turned, atol=1e-6)


def test_a_place_is_looked_up_where_it_was_recorded_below_its_own_elevation() -> None:
    is_hit = np.zeros((1, 4, FIRINGS), bool)
    is_hit[0, 2] = True
    down = np.deg2rad(0.7)
    place_m = places(np.linspace(-2.0, 2.0, 9), np.full(9, ELEVATION[2] + down))
    found = shares(place_m, np.eye(4)[None], np.ones(1), is_hit, turned_down_rad=down)
    assert np.allclose(found, 1.0, atol=1e-6)
