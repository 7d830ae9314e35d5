import math
import time

import numpy as np
import pytest

from nvsf_core.errors import DataError, ShapeError
from nvsf_core.sensors.linear_pano import LinearPano

H, W, FOV_UP_DEG, FOV_DEG, MAX_M = 66, 1030, 2.0, 26.9, 80.0


def _plain_loop(points, intensities):
    """The papers' projection, point by point, from its description."""
    fov_rad, fov_down_rad = FOV_DEG / 180 * math.pi, (FOV_DEG - FOV_UP_DEG) / 180 * math.pi
    range_m, intensity = np.zeros((H, W)), np.zeros((H, W))
    for (x, y, z), value in zip(points.tolist(), intensities.tolist(), strict=True):
        distance = math.sqrt(x * x + y * y + z * z)
        if distance >= MAX_M:
            continue
        column = round((math.pi - math.atan2(y, x)) / (2 * math.pi / W))
        elevation = math.atan2(z, math.sqrt(x * x + y * y)) + fov_down_rad
        row = round(H - elevation / (fov_rad / H))
        if not (0 <= row < H and 0 <= column < W):
            continue
        if range_m[row, column] == 0.0 or range_m[row, column] > distance:
            range_m[row, column], intensity[row, column] = distance, value
    return range_m.astype(np.float32), intensity.astype(np.float32)


def _random_scan(seed, count=20_000):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3)) * (30.0, 30.0, 4.0)
    return points.astype(np.float32), rng.random(count).astype(np.float32)


@pytest.mark.parametrize("seed", range(3))
def test_with_quirks_it_equals_the_plain_loop_on_random_points(seed):
    points, intensity = _random_scan(seed)
    for ours, loop in zip(
        LinearPano(reference_quirks=True).project(points, intensity),
        _plain_loop(points, intensity),
        strict=True,
    ):
        np.testing.assert_array_equal(ours, loop)


@pytest.mark.parametrize("scene", ["k360_street", "kitti0005_van_cyclist"])
def test_with_quirks_it_equals_the_plain_loop_on_real_scans(scene, real_scans):
    for scan in real_scans(scene, 16):
        ours = LinearPano(reference_quirks=True).project(scan[:, :3], scan[:, 3])
        loop = _plain_loop(scan[:, :3], scan[:, 3])
        np.testing.assert_array_equal(ours[0], loop[0])
        # Equally near returns of one cell may differ in intensity; the first of them wins in both.
        np.testing.assert_array_equal(ours[1], loop[1])


def test_the_seam_wraps_unless_quirks_are_asked_for():
    just_past = np.float32([[-10.0, -0.01, 0.0], [-10.0, 0.01, 0.0]])
    intensity = np.float32([0.5, 0.6])
    _, wrapped = LinearPano().project(just_past[:1], intensity[:1])
    assert wrapped[:, 0].max() == np.float32(0.5)
    dropped_m, _ = LinearPano(reference_quirks=True).project(just_past[:1], intensity[:1])
    assert not dropped_m.any()
    kept_m, _ = LinearPano(reference_quirks=True).project(just_past[1:], intensity[1:])
    assert (kept_m[:, 0] > 0).sum() == 1


def test_off_the_seam_quirks_change_nothing():
    points, intensity = _random_scan(5)
    away = np.abs(np.arctan2(points[:, 1], points[:, 0])) < 3.1
    plain = LinearPano().project(points[away], intensity[away])
    quirky = LinearPano(reference_quirks=True).project(points[away], intensity[away])
    np.testing.assert_array_equal(plain[0], quirky[0])


def test_halves_round_to_the_even_cell():
    pano = LinearPano(height=4, width=4, fov_up_deg=45.0, fov_deg=90.0)
    half_column = np.float32([[1.0, 1.0, 0.0], [1.0, -1.0, 0.0]])  # columns 1.5 and 2.5
    row, column, _, kept = pano.cells(half_column)
    assert column.tolist() == [2, 2]
    assert row.tolist() == [2, 2]
    assert kept.all()


def test_limits_of_range_and_elevation_are_strict():
    _, _, _, kept = LinearPano().cells(np.float32([[80.0, 0, 0], [79.99, 0, 0], [0, 0, 0], [1, 0, 1]]))
    assert kept.tolist() == [False, True, False, False]


def test_points_of_an_image_project_back_to_it():
    rng = np.random.default_rng(0)
    image_m = np.where(rng.random((H, W)) < 0.7, rng.uniform(1.0, 79.0, (H, W)), 0.0).astype(np.float32)
    points = LinearPano().points(image_m)
    back_m, _ = LinearPano().project(points, np.ones(len(points)))
    np.testing.assert_allclose(back_m, image_m, rtol=1e-6)


def test_a_round_trip_moves_a_point_by_half_a_cell_at_most():
    points, _ = _random_scan(7)
    pano = LinearPano()
    row, column, range_m, kept = pano.cells(points)
    back = pano.directions()[row[kept], column[kept]] * range_m[kept, None]
    shift = np.linalg.norm(back - points[kept], axis=1) / range_m[kept]
    assert shift.max() < np.deg2rad(math.hypot(0.204, 0.175)) * 1.001


def test_not_a_number_is_refused_not_dropped():
    with pytest.raises(DataError, match="1 of 2"):
        LinearPano().project(np.float32([[np.nan, 0, 0], [1, 0, 0]]), np.zeros(2))
    with pytest.raises(ShapeError):
        LinearPano().project(np.zeros((3, 2)), np.zeros(3))
    with pytest.raises(ShapeError):
        LinearPano().points(np.zeros((3, 2)))


def test_it_is_fast_enough():
    rng = np.random.default_rng(0)
    points = (rng.normal(size=(122_000, 3)) * (20, 20, 1.5)).astype(np.float32)
    intensity = np.ones(len(points), np.float32)
    seconds = []
    for _ in range(7):
        started = time.process_time()
        LinearPano().project(points, intensity)
        seconds.append(time.process_time() - started)
    assert min(seconds) < 1 / 25
