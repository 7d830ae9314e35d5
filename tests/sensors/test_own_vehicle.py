import numpy as np

from nvsf_core.sensors.beam_table import sensor_rays
from nvsf_core.sensors.own_vehicle import PlacedScan, learn_own_vehicle
from nvsf_core.sensors.tables import HDL_64E

BONNET_LASERS = np.arange(50, 64)
BONNET_RETURNS = 200 * len(BONNET_LASERS)


def _scan(seed: int, near_m: float = 2.0, at_m: float | None = None) -> PlacedScan:
    """A bonnet ahead on the lowest lasers, and a street around; a metre along the road each, or `at_m`."""
    rng = np.random.default_rng(seed)
    azimuth = np.linspace(-0.3, 0.3, 200) + rng.uniform(0, 0.003)
    laser = np.repeat(BONNET_LASERS, 200)
    origin, direction = sensor_rays(HDL_64E, np.tile(azimuth, len(BONNET_LASERS)), laser)
    bonnet = origin + (near_m + rng.normal(0, 0.01, len(laser)))[:, None] * direction
    street_laser = rng.integers(0, 64, 3000)
    origin, direction = sensor_rays(HDL_64E, rng.uniform(-np.pi, np.pi, 3000), street_laser)
    # Beyond 12 m: nothing else is where the bonnet was in another scan.
    street = origin + rng.uniform(12, 60, 3000)[:, None] * direction
    intensity = np.concatenate([np.full(len(bonnet), 0.25), rng.random(3000)])
    lasers = np.concatenate([laser, street_laser])
    return _placed(np.concatenate([bonnet, street]), intensity, lasers, seed if at_m is None else at_m)


def _placed(points: np.ndarray, intensity: np.ndarray, laser: np.ndarray, at_m: float) -> PlacedScan:
    position = np.array([at_m, 0.0, 0.0])
    return PlacedScan(points.astype(np.float32), intensity, laser, points + position, position)


def _with(scan: PlacedScan, points: np.ndarray, laser: int = 30) -> PlacedScan:
    """The scan with more returns, of one laser."""
    return _placed(
        np.concatenate([scan.points_m, points]),
        np.concatenate([scan.intensity, np.full(len(points), 0.5)]),
        np.concatenate([scan.laser, np.full(len(points), laser)]),
        float(scan.position_m[0]),
    )


def _wall(at_m: float) -> np.ndarray:
    """A wall 2 m to the left of the road, from 0 to 20 m along it, in the sensor's frame at `at_m`."""
    along, height = np.meshgrid(np.arange(0.0, 20.0, 0.1), np.arange(-0.5, 0.5, 0.1), indexing="ij")
    return np.stack([along.ravel() - at_m, np.full(along.size, 2.0), height.ravel()], axis=1)


def test_what_is_near_in_most_scans_is_the_own_vehicle():
    scans = [_scan(seed) for seed in range(8)]
    own = learn_own_vehicle(HDL_64E, scans, 1000)
    for scan in [*scans, _scan(99)]:
        bonnet = np.arange(len(scan.points_m)) < BONNET_RETURNS
        np.testing.assert_array_equal(own.is_own(scan.points_m), bonnet)
    found = own.range_m > 0
    assert np.flatnonzero(found.any(axis=1)).tolist() == BONNET_LASERS.tolist()
    np.testing.assert_allclose(own.intensity[found], 0.25)
    typical_m = np.median(np.linalg.norm(scans[0].points_m[:BONNET_RETURNS], axis=1))
    np.testing.assert_allclose(own.range_m[found], typical_m, atol=0.03)


def test_what_comes_near_once_is_not_the_own_vehicle():
    scans = [_scan(seed, near_m=2.0 if seed == 0 else 4.0) for seed in range(8)]
    own = learn_own_vehicle(HDL_64E, scans, 1000)
    assert not own.range_m.any()
    assert not own.is_own(scans[0].points_m).any()


def test_an_edge_that_each_laser_meets_in_a_fifth_of_the_scans_is_the_own_vehicle():
    # What leaked on KITTI-360: a roof mount's edge, met by another laser or at another azimuth each time.
    scans = []
    for seed in range(10):
        edge = np.array([[0.03 * (seed % 3), -1.85, 0.1 - 0.04 * (seed % 5)]])
        scans.append(_with(_scan(seed), edge, laser=8 + seed % 5))
    own = learn_own_vehicle(HDL_64E, scans, 1000)
    assert all(own.is_own(scan.points_m)[-1] for scan in scans)


def test_a_wall_beside_the_road_is_not_the_own_vehicle():
    scans = [_with(_scan(seed), _wall(float(seed))) for seed in range(12)]
    own = learn_own_vehicle(HDL_64E, scans, 1000)
    for scan in scans:
        is_own = own.is_own(scan.points_m)
        assert is_own[:BONNET_RETURNS].all()
        assert not is_own[BONNET_RETURNS:].any()


def test_a_lorry_that_overtakes_slowly_is_not_the_own_vehicle():
    # The places beside the sensor in the first scans are met from afar by none.
    along, height = np.meshgrid(np.arange(-2.0, 10.0, 0.1), np.arange(-0.5, 0.5, 0.1), indexing="ij")
    side = np.stack([along.ravel(), np.full(along.size, 2.1), height.ravel()], axis=1)
    step_m = np.array([0.09, 0.0, 0.0])
    scans = [_with(_scan(seed, at_m=0.8 * seed), side + seed * step_m) for seed in range(6)]
    own = learn_own_vehicle(HDL_64E, scans, 1000)
    for scan in scans:
        is_own = own.is_own(scan.points_m)
        assert is_own[:BONNET_RETURNS].all()
        assert not is_own[BONNET_RETURNS:].any()


def test_a_long_wait_beside_a_lorry_does_not_make_it_the_own_vehicle():
    lorry = np.stack([np.linspace(-1, 1, 50), np.full(50, -2.2), np.zeros(50)], axis=1)
    waiting = [_with(_scan(seed, at_m=0.0), lorry) for seed in range(20)]
    driving = [_scan(20 + step, at_m=1.0 + step) for step in range(6)]
    own = learn_own_vehicle(HDL_64E, waiting + driving, 1000)
    is_own = own.is_own(waiting[0].points_m)
    assert is_own[:BONNET_RETURNS].all()
    assert not is_own[BONNET_RETURNS:].any()


def test_in_a_drive_that_only_stands_all_scans_count_alike():
    scans = [_scan(seed, at_m=0.0) for seed in range(8)]
    own = learn_own_vehicle(HDL_64E, scans, 1000)
    assert own.is_own(scans[0].points_m).sum() == BONNET_RETURNS


def test_it_needs_no_laser_ids():
    scans = [
        _placed(scan.points_m, scan.intensity, np.full(len(scan.laser), -1), float(seed))
        for seed, scan in enumerate(map(_scan, range(8)))
    ]
    own = learn_own_vehicle(HDL_64E, scans, 1000)
    near = np.linalg.norm(scans[0].points_m, axis=1) < 2.5
    assert own.is_own(scans[0].points_m)[near].all()
    assert own.range_m.any()


def test_without_training_scans_nothing_is_own():
    own = learn_own_vehicle(HDL_64E, [], 2000)
    assert own.range_m.shape == (64, 2000)
    assert not own.range_m.any()
    assert not own.is_own(np.ones((5, 3), np.float32)).any()
