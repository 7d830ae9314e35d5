import numpy as np
import pytest

from nvsf_core.sensors.beam_table import (
    BeamPano,
    corrected_rays,
    encoder_angle,
    firing_grid,
    firing_phase,
    recorded_ray_of_points,
    sensor_rays,
    turn_up,
    wrap_angle,
)
from nvsf_core.sensors.lasers import recover_lasers
from nvsf_core.sensors.tables import HDL_64E, SENSOR_TABLES, VLP_16


def _grid(table, angles=50):
    azimuth = np.linspace(-np.pi, np.pi, angles)[None, :].repeat(table.laser_count, axis=0)
    return azimuth, np.arange(table.laser_count)[:, None]


@pytest.mark.parametrize("name", sorted(SENSOR_TABLES))
def test_points_on_a_ray_follow_the_sensor_model(name):
    table = SENSOR_TABLES[name]
    azimuth, laser = _grid(table)
    origin, direction = sensor_rays(table, azimuth, laser)
    np.testing.assert_allclose(np.linalg.norm(direction, axis=-1), 1.0)
    point = origin + 20.0 * direction
    range_m = np.linalg.norm(point, axis=-1)
    elevation = np.arcsin(point[..., 2] / range_m)
    expected = table.elevation_rad + table.vertical_offset_m / range_m.T
    np.testing.assert_allclose(elevation.T, expected, atol=6e-5)  # the model is of first order in v/r
    aside = table.horizontal_offset_m / (range_m.T * np.cos(table.elevation_rad))
    seen = np.arctan2(point[..., 1], point[..., 0])
    np.testing.assert_allclose(wrap_angle(seen - azimuth).T, aside, atol=2e-5)


@pytest.mark.parametrize("name", sorted(SENSOR_TABLES))
def test_the_ray_of_a_simulated_point_is_the_ray_it_was_made_with(name):
    table = SENSOR_TABLES[name]
    azimuth, laser = _grid(table)
    azimuth, laser = azimuth.ravel(), np.broadcast_to(laser, azimuth.shape).ravel()
    origin, direction = sensor_rays(table, azimuth, laser)
    range_m = np.random.default_rng(0).uniform(1.0, 80.0, len(azimuth))
    found = recorded_ray_of_points(table, origin + range_m[:, None] * direction, laser)
    for ours, true in zip(found, (origin, direction, range_m), strict=True):
        np.testing.assert_allclose(ours, true, atol=1e-12)
    points = origin + range_m[:, None] * direction
    np.testing.assert_allclose(wrap_angle(encoder_angle(table, points, laser) - azimuth), 0.0, atol=1e-12)


def test_origin_plus_range_times_direction_is_the_point_as_recorded():
    rng = np.random.default_rng(1)
    points = rng.normal(size=(1000, 3)) * 30
    laser = rng.integers(-1, 64, 1000)
    origin, direction, range_m = recorded_ray_of_points(HDL_64E, points, laser)
    np.testing.assert_allclose(origin + range_m[:, None] * direction, points, atol=1e-12)
    assert not origin[laser < 0].any()


def test_real_returns_lie_on_the_rays_of_the_table(real_scans):
    for scene in ("k360_street", "kitti0005_van_cyclist"):
        scan = real_scans(scene, 16)[0]
        laser, _, _ = recover_lasers(scan[:, :3], HDL_64E)
        _, direction, _ = recorded_ray_of_points(HDL_64E, scan[:, :3], laser)
        off_deg = np.rad2deg(np.abs(np.arcsin(direction[:, 2]) - HDL_64E.elevation_rad[laser]))
        assert np.quantile(off_deg, 0.999) < 0.02


def test_the_correction_raises_every_ray_by_its_angle_within_its_plane():
    azimuth, laser = _grid(HDL_64E)
    _, direction = sensor_rays(HDL_64E, azimuth, laser)
    origin, turned = corrected_rays(HDL_64E, azimuth, laser)
    rise = np.arcsin(turned[..., 2]) - np.arcsin(direction[..., 2])
    np.testing.assert_allclose(rise, np.deg2rad(0.205), atol=1e-12)
    across = turned[..., 0] * -np.sin(azimuth) + turned[..., 1] * np.cos(azimuth)
    np.testing.assert_allclose(across, 0.0, atol=1e-12)
    # Turned about the sensor's centre: distances from it stay.
    plain, _ = sensor_rays(HDL_64E, azimuth, laser)
    np.testing.assert_allclose(np.linalg.norm(origin, axis=-1), np.linalg.norm(plain, axis=-1))


def test_turning_up_and_down_again_changes_nothing():
    azimuth, laser = _grid(VLP_16)
    rays = sensor_rays(VLP_16, azimuth, laser)
    back = turn_up(*turn_up(*rays, azimuth, 0.3), azimuth, -0.3)
    for ours, true in zip(back, rays, strict=True):
        np.testing.assert_allclose(ours, true, atol=1e-14)


def test_firings_run_clockwise_from_the_rear_and_fill_the_turn():
    azimuth, fraction = firing_grid(VLP_16, 1808)
    assert azimuth.shape == (16, 1808)
    assert (np.diff(fraction) > 0).all()
    assert abs(fraction[0] + 0.5) < 1e-3
    assert abs(fraction[-1] - 0.5) < 1e-3
    np.testing.assert_allclose(azimuth[3], -2 * np.pi * fraction)
    assert (np.abs(azimuth) <= np.pi).all()


def test_a_wrapped_angle_lies_in_the_half_open_turn():
    angle = np.array([-np.pi, np.pi, 3 * np.pi, 0.0, -3.5, 7.0])
    wrapped = wrap_angle(angle)
    assert (wrapped > -np.pi).all()
    assert (wrapped <= np.pi).all()
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angle), atol=1e-12)


def test_points_of_a_beam_image_project_back_to_it():
    rng = np.random.default_rng(0)
    pano = BeamPano(HDL_64E)
    image_m = np.where(rng.random((64, 1030)) < 0.8, rng.uniform(2.0, 79.0, (64, 1030)), 0).astype(np.float32)
    points = pano.points(image_m)
    laser = np.nonzero(image_m)[0]
    back_m, _ = pano.project(points, np.ones(len(points)), laser)
    np.testing.assert_allclose(back_m, image_m, rtol=1e-6)


def test_returns_of_unknown_lasers_are_left_out():
    image_m, _ = BeamPano(HDL_64E).project(np.ones((5, 3)), np.ones(5), np.full(5, -1))
    assert not image_m.any()


@pytest.mark.parametrize("phase", [0.0, 0.25, 0.9])
def test_firings_that_agree_have_their_phase_and_others_the_mean(phase):
    rng = np.random.default_rng(0)
    steps = np.arange(500) + phase
    assert firing_phase(steps + rng.normal(0.0, 0.03, 500)) == pytest.approx(phase, abs=0.01)
    assert firing_phase(steps + rng.uniform(0.0, 1.0, 500)) == 0.5
    assert firing_phase(steps - 1e-6) == pytest.approx(phase, abs=1e-5)  # 0 does not become 1
    assert firing_phase(np.zeros(0)) == 0.5
