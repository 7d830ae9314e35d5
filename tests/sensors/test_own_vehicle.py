import numpy as np

from nvsf_core.sensors.beam_table import sensor_rays
from nvsf_core.sensors.own_vehicle import learn_own_vehicle
from nvsf_core.sensors.tables import HDL_64E

BONNET_LASERS = np.arange(50, 64)


def _scan(seed: int, near_m: float = 2.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A bonnet ahead on the lowest lasers, and a street around."""
    rng = np.random.default_rng(seed)
    azimuth = np.linspace(-0.3, 0.3, 200) + rng.uniform(0, 0.003)
    laser = np.repeat(BONNET_LASERS, 200)
    origin, direction = sensor_rays(HDL_64E, np.tile(azimuth, len(BONNET_LASERS)), laser)
    bonnet = origin + (near_m + rng.normal(0, 0.01, len(laser)))[:, None] * direction
    street_laser = rng.integers(0, 64, 3000)
    origin, direction = sensor_rays(HDL_64E, rng.uniform(-np.pi, np.pi, 3000), street_laser)
    street = origin + rng.uniform(3, 60, 3000)[:, None] * direction
    points = np.concatenate([bonnet, street])
    intensity = np.concatenate([np.full(len(bonnet), 0.25), rng.random(3000)])
    return points.astype(np.float32), intensity, np.concatenate([laser, street_laser])


def test_what_is_near_in_most_scans_is_the_own_vehicle():
    scans = [_scan(seed) for seed in range(8)]
    own = learn_own_vehicle(HDL_64E, scans, 1000)
    for points, _, laser in [*scans, _scan(99)]:
        mask = own.is_own(HDL_64E, points, laser)
        bonnet = np.arange(len(points)) < len(BONNET_LASERS) * 200
        np.testing.assert_array_equal(mask, bonnet)
    found = own.range_m > 0
    assert np.flatnonzero(found.any(axis=1)).tolist() == BONNET_LASERS.tolist()
    np.testing.assert_allclose(own.intensity[found], 0.25)
    points, _, _ = scans[0]
    typical_m = np.median(np.linalg.norm(points[: len(BONNET_LASERS) * 200], axis=1))
    np.testing.assert_allclose(own.range_m[found], typical_m, atol=0.03)


def test_what_comes_near_once_is_not_the_own_vehicle():
    scans = [_scan(seed, near_m=2.0 if seed == 0 else 4.0) for seed in range(8)]
    own = learn_own_vehicle(HDL_64E, scans, 1000)
    assert not own.range_m.any()
    assert not own.is_own(HDL_64E, scans[0][0], scans[0][2]).any()


def test_it_needs_no_laser_ids():
    scans = [(points, intensity, np.full(len(points), -1)) for points, intensity, _ in map(_scan, range(8))]
    own = learn_own_vehicle(HDL_64E, scans, 1000)
    points, _, laser = scans[0]
    near = np.linalg.norm(points, axis=1) < 2.5
    assert own.is_own(HDL_64E, points, laser)[near].mean() > 0.95


def test_without_training_scans_nothing_is_own():
    own = learn_own_vehicle(HDL_64E, [], 2000)
    assert own.range_m.shape == (64, 2000)
    assert not own.range_m.any()
