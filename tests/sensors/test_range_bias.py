"""Laws of the lasers' range biases, in a room whose walls and biases are known."""

from dataclasses import replace

import numpy as np
import pytest

from nvsf_core.demo.lidar import RANGE_NOISE_M, exact_rays
from nvsf_core.demo.world import DemoWorld
from nvsf_core.sensors.beam_table import sensor_rays
from nvsf_core.sensors.sensor_errors import learn_range_bias
from nvsf_core.sensors.sweep import Trajectory, sweep_rays
from nvsf_core.sensors.tables import VLP_16

LASERS = 8


def scans_of_a_room(bias_m: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Returns of a sensor that wanders through a room of 16 x 12 x 5 m, each laser with its own bias."""
    rng = np.random.default_rng(seed)
    count = 120_000
    origin = rng.uniform((-4, -3, -0.5), (4, 3, 0.5), (count, 3))
    direction = rng.normal(size=(count, 3)) * (1.0, 1.0, 0.6)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    wall_m = np.where(direction > 0, 1.0, -1.0) * (8.0, 6.0, 2.5)
    exact_m = ((wall_m - origin) / direction).min(axis=1)
    laser = rng.integers(-1, LASERS, count).astype(np.int16)
    recorded_m = exact_m + np.append(bias_m, 0.0)[laser] + rng.normal(0, 0.01, count)
    return origin, direction, recorded_m.astype(np.float32), laser


def test_a_lasers_bias_is_found_to_millimetres() -> None:
    true_m = np.array([0.06, -0.03, 0.0, 0.02, -0.08, 0.01, 0.04, -0.02])
    found_m = learn_range_bias(*scans_of_a_room(true_m, 0), LASERS)
    assert np.abs(found_m - true_m).max() < 0.004


def test_lasers_that_agree_are_left_alone() -> None:
    assert np.abs(learn_range_bias(*scans_of_a_room(np.zeros(LASERS), 1), LASERS)).max() < 0.002


def test_a_perfect_sensor_that_stands_has_no_biases_though_corners_look_like_some() -> None:
    rng, lasers = np.random.default_rng(0), np.arange(16)
    azimuth_rad = np.broadcast_to(np.linspace(0.0, 2.0 * np.pi, 1800, endpoint=False), (16, 1800))
    exact = exact_rays(
        DemoWorld(2), VLP_16, lasers, azimuth_rad, np.zeros(azimuth_rad.shape), mount=None, own_vehicle=False
    )
    origin, direction = sensor_rays(VLP_16, azimuth_rad, lasers[:, None])
    laser = np.broadcast_to(lasers[:, None], azimuth_rad.shape)
    there = (exact.chance > 0.5) & (exact.range_m < 80.0)
    scans = 8
    of_one = (
        np.broadcast_to(origin, direction.shape)[there],
        direction[there],
        exact.range_m[there],
        laser[there],
    )
    origin, direction, range_m, laser = (np.concatenate([column] * scans) for column in of_one)
    recorded_m = range_m + rng.normal(0.0, RANGE_NOISE_M, len(range_m))
    assert (learn_range_bias(origin, direction, recorded_m, laser, 16) == 0.0).all()


@pytest.mark.parametrize("kept", [slice(0, 0), slice(0, 40)])
def test_without_planes_nobody_is_suspected(kept) -> None:
    columns = (column[kept] for column in scans_of_a_room(np.full(LASERS, 0.1), 2))
    assert (learn_range_bias(*columns, LASERS) == 0.0).all()


def test_a_simulated_laser_records_its_bias() -> None:
    poses = np.tile(np.eye(4), (2, 1, 1))
    trajectory = Trajectory(np.array([0.0, 1.0]), poses, np.eye(4))
    biased = replace(VLP_16, range_bias_m=np.linspace(-0.05, 0.05, 16))
    rays, exact = (sweep_rays(table, np.arange(16), 90, trajectory, 0.5, 0.1) for table in (biased, VLP_16))
    assert np.array_equal(rays.origin_m, exact.origin_m), "the ray in the world is the laser's, biased or not"
    recorded_m, exact_m = (r.recorded_origin_m + r.recorded_direction * 7.0 for r in (rays, exact))
    longer_m = np.einsum("ni,ni->n", recorded_m - exact_m, rays.recorded_direction)
    assert np.allclose(longer_m, biased.range_bias_m[rays.laser], atol=1e-6)
