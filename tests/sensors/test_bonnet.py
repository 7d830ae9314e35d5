"""The bonnet as a mirror: the law of reflection, and learning it from scans."""

from pathlib import Path

import numpy as np
import pytest

from nvsf_core.drives.kitti360.scans import parse_scan, read_scan_bytes
from nvsf_core.sensors.bonnet import Bonnet, ScanReturns, below_road, fit_bonnet
from nvsf_core.sensors.scan_timing import scan_timing
from nvsf_core.sensors.tables import HDL_64E
from tests.sensors.bonnet_street import SHAPE, WALL_M, scan_of_street

REAL = Path(__file__).resolve().parents[3] / "shared/data/kitti0005_van_cyclist"


def test_a_level_mirror_turns_a_ray_up_by_as_much_as_it_came_down() -> None:
    level = Bonnet(np.array([-1.0, 0.0, 0.0, 0.0, 0.0]))
    down = np.array([[1.0, 0.0, -1.0], [1.0, 0.0, 1.0]]) / np.sqrt(2.0)
    distance_m, point_m, onward = level.reflect(np.zeros((2, 3)), down)
    assert np.allclose(distance_m, [np.sqrt(2.0), np.inf])
    assert np.allclose(point_m[0], [1.0, 0.0, -1.0])
    assert np.allclose(onward[0], [np.sqrt(0.5), 0.0, np.sqrt(0.5)])


def test_a_ray_meets_a_bent_surface_where_it_says_and_leaves_it_at_the_same_angle() -> None:
    bonnet = Bonnet(SHAPE)
    direction = np.random.default_rng(0).normal(size=(500, 3)) * [1.0, 0.3, 0.2] - [0.0, 0.0, 0.4]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    distance_m, point_m, onward = bonnet.reflect(np.zeros((500, 3)), direction)
    met = np.isfinite(distance_m)
    x, y, z = point_m[met].T
    assert met.sum() > 100
    assert np.allclose(z, SHAPE[0] + SHAPE[1] * x + SHAPE[2] * y + SHAPE[3] * x**2 + SHAPE[4] * y**2)
    assert np.allclose(np.linalg.norm(onward, axis=1), 1.0)
    slope = np.stack([-SHAPE[1] - 2 * SHAPE[3] * x, -SHAPE[2] - 2 * SHAPE[4] * y, np.ones(len(x))], axis=-1)
    assert np.allclose((direction[met] * slope).sum(axis=1), -(onward[met] * slope).sum(axis=1))


def test_the_bonnet_is_found_and_its_mirrored_returns_lie_on_the_wall() -> None:
    scan, mirrored = scan_of_street(Bonnet(SHAPE))
    found = fit_bonnet(HDL_64E, [scan])
    assert found is not None
    below = below_road(scan.points_m)
    assert mirrored[below].all() and below.sum() > 100
    assert found.is_mirrored(HDL_64E, scan)[below].mean() > 0.95
    assert not found.is_mirrored(HDL_64E, scan)[~below].any()
    images_m = found.images(HDL_64E, ScanReturns(scan.points_m[below], scan.laser[below]))
    assert np.median(np.abs(images_m[:, 0] - WALL_M)) < 0.2


def test_a_car_that_mirrors_nothing_has_no_bonnet() -> None:
    scan, _ = scan_of_street(None)
    assert fit_bonnet(HDL_64E, [scan]) is None
    assert fit_bonnet(HDL_64E, []) is None


def test_returns_below_the_road_that_no_mirror_explains_make_no_bonnet() -> None:
    scan, _ = scan_of_street(None)
    noise = np.random.default_rng(0).uniform([4.0, -2.0, -9.0], [12.0, 2.0, -5.0], (200, 3))
    points_m = np.concatenate([scan.points_m, noise.astype(np.float32)])
    laser = np.concatenate([scan.laser, np.full(200, 60)])
    assert fit_bonnet(HDL_64E, [ScanReturns(points_m, laser)]) is None


@pytest.mark.skipif(not REAL.exists(), reason=f"the real drive {REAL.name} is not beside the checkout")
def test_a_real_car_mirrors_what_lies_below_the_road() -> None:
    files = sorted(REAL.rglob("velodyne_points/data/*.bin"))
    scans = [parse_scan(path, read_scan_bytes(path)).points[:, :3] for path in (files[5], files[20])]
    returns = [ScanReturns(points_m, scan_timing(points_m, HDL_64E).laser) for points_m in scans]
    bonnet = fit_bonnet(HDL_64E, returns)
    assert bonnet is not None and -0.9 < bonnet.shape[0] < -0.5
    below = sum(int(below_road(one.points_m).sum()) for one in returns)
    assert sum(int(bonnet.is_mirrored(HDL_64E, one).sum()) for one in returns) > 0.85 * below
