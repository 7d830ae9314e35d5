import numpy as np
import pytest

from nvsf_core.sensors.beam_table import sensor_rays, wrap_angle
from nvsf_core.sensors.lasers import BEAM_TABLE, FILE_ORDER, UNKNOWN, recover_lasers
from nvsf_core.sensors.scan_timing import scan_timing
from nvsf_core.sensors.sweep import sweep_fraction
from nvsf_core.sensors.tables import HDL_64E, OS1_64, VLP_16, LaserTable


@pytest.mark.parametrize(
    ("scene", "least", "most"), [("k360_street", 2171, 2174), ("kitti0005_van_cyclist", 2150, 2152)]
)
def test_a_real_scan_is_64_lasers_in_file_order_that_share_their_firings(scene, least, most, real_scans):
    for scan in real_scans(scene, 13):
        timing = scan_timing(scan[:, :3], HDL_64E)
        assert timing.source == FILE_ORDER
        assert "64 turns" in timing.evidence
        assert least <= timing.firings <= most
        assert np.unique(timing.laser).tolist() == list(range(64))
        cell = timing.firing.astype(int) * 64 + timing.laser
        assert len(cell) - len(np.unique(cell)) <= 2
        filled = len(cell) / (64 * timing.firings)
        assert 0.85 < filled < 0.92
        own_fraction = sweep_fraction(np.arctan2(scan[:, 1], scan[:, 0]))
        apart = wrap_angle(2 * np.pi * (timing.sweep_fraction - own_fraction))
        assert np.abs(apart).max() < np.deg2rad(12)  # 115 steps, and the lever arm nearby


def test_a_shuffled_scan_is_assigned_by_the_beam_table(real_scans):
    scan = real_scans("k360_street", 40)[0]
    in_order, _, _ = recover_lasers(scan[:, :3], HDL_64E)
    order = np.random.default_rng(0).permutation(len(scan))
    laser, source, evidence = recover_lasers(scan[order, :3], HDL_64E)
    assert source == BEAM_TABLE
    assert "not one a laser" in evidence
    assert (laser == in_order[order]).mean() > 0.9999


@pytest.mark.parametrize("firings", [64, 500, 2172])
@pytest.mark.parametrize("lasers", [range(64), range(0, 64, 8)])
def test_lasers_and_firings_of_a_simulated_scan_are_found_again(firings, lasers, simulated_scan):
    points, laser, firing = simulated_scan(HDL_64E, np.array(lasers), firings)
    timing = scan_timing(points, HDL_64E)
    assert timing.source == FILE_ORDER
    np.testing.assert_array_equal(timing.laser, laser)
    assert timing.firings == firings
    np.testing.assert_array_equal(timing.firing, firing)


def test_time_grows_with_the_firing_and_is_shared_by_all_lasers(simulated_scan):
    points, _, _ = simulated_scan(HDL_64E, np.arange(64), 500)
    timing = scan_timing(points, HDL_64E)
    by_firing = [np.unique(timing.sweep_fraction[timing.firing == k]) for k in range(500)]
    assert all(len(times) == 1 for times in by_firing)
    times = np.concatenate(by_firing)
    assert (np.diff(times) > 0).all()
    assert times[0] >= -0.5
    assert times[-1] < 0.5


def test_a_lost_packet_leaves_the_later_firings_where_they_were(simulated_scan):
    points, _, firing = simulated_scan(HDL_64E, np.arange(64), 2172)
    kept = (firing < 1000) | (firing >= 1006)
    timing = scan_timing(points[kept], HDL_64E)
    assert timing.firings == 2172
    assert "6 of them lost" in timing.evidence
    np.testing.assert_array_equal(timing.firing, firing[kept])


def test_columns_over_sky_are_firings_too_where_the_encoder_fires_at_every_step(simulated_scan):
    points, laser, firing = simulated_scan(OS1_64, np.arange(64), 1024)
    # The last columns, one in the middle, and a stretch that three lasers alone see.
    is_sky = (firing >= 1000) | (firing == 400) | ((firing >= 500) & (firing < 560))
    kept = ~is_sky | ((laser < 3) & (firing < 1000))
    timing = scan_timing(points[kept], OS1_64)
    assert timing.firings == 1024 and "of them lost" in timing.evidence
    np.testing.assert_array_equal(timing.firing, firing[kept])


@pytest.mark.parametrize("firings", [512, 768])
def test_a_sensor_that_fires_at_some_steps_of_its_encoder_has_no_more_firings(firings, simulated_scan):
    points, _, firing = simulated_scan(OS1_64, np.arange(64), firings)
    timing = scan_timing(points, OS1_64)
    assert timing.firings == firings
    np.testing.assert_array_equal(timing.firing, firing)


def test_off_the_lattice_firings_come_from_the_spacing(simulated_scan):
    points, laser, firing = simulated_scan(HDL_64E, np.arange(64), 500, keep=1.0)
    angle = 0.5 * HDL_64E.step_rad * np.random.default_rng(0).uniform(-1, 1, 500)[firing]
    cos, sin = np.cos(angle), np.sin(angle)
    x, y, z = points.T
    timing = scan_timing(np.stack([cos * x - sin * y, sin * x + cos * y, z], 1), HDL_64E)
    assert "no encoder lattice" in timing.evidence
    assert timing.firings == 500
    apart = np.abs((timing.firing - firing + 250) % 500 - 250)
    assert apart.max() <= 1
    np.testing.assert_array_equal(timing.laser, laser)  # returns turned across azimuth 0 included


@pytest.mark.parametrize("phase", [0.0, 0.3, 0.5, 0.97])
def test_off_the_lattice_firings_lie_where_their_returns_do(phase):
    count = 720
    turned = (np.arange(count) + phase) / count
    laser, firing = (one.ravel() for one in np.meshgrid(np.arange(16), np.arange(count), indexing="ij"))
    azimuth = wrap_angle(np.pi - 2.0 * np.pi * turned)[firing]
    origin, direction = sensor_rays(VLP_16, azimuth, laser)
    ring = (15 - laser).astype(np.int64)
    timing = scan_timing((origin + 9.0 * direction).astype(np.float32), VLP_16, ring=ring)
    assert "no encoder lattice" in timing.evidence and timing.firings == count
    np.testing.assert_array_equal(timing.firing, firing)
    np.testing.assert_allclose(timing.sweep_fraction, turned[firing] - 0.5, atol=1e-5)


def test_a_sensor_that_is_not_the_tables_stays_unknown(simulated_scan):
    points, _, _ = simulated_scan(VLP_16, np.arange(16), 500)
    timing = scan_timing(points, HDL_64E)
    assert timing.source == UNKNOWN
    assert (timing.laser == -1).all()
    assert (timing.firing == -1).all()
    assert timing.firings == 0
    own = sweep_fraction(np.arctan2(points[:, 1], points[:, 0]))
    np.testing.assert_allclose(timing.sweep_fraction, own, atol=1e-6)
    assert scan_timing(points, VLP_16).source == FILE_ORDER


def test_an_empty_scan_is_unknown():
    timing = scan_timing(np.zeros((0, 3), np.float32), HDL_64E)
    assert timing.source == UNKNOWN
    assert len(timing.sweep_fraction) == 0


def even_scan(table: LaserTable, firings: int) -> np.ndarray:
    """(N, 3) points 10 m away, laser after laser, of firings that lie between the table's usual ones."""
    azimuth = np.tile((np.arange(firings) + 0.5) * (2.0 * np.pi / firings), (table.laser_count, 1))
    origin, direction = sensor_rays(table, azimuth, np.arange(table.laser_count)[:, None])
    return (origin + 10.0 * direction).reshape(-1, 3)


@pytest.mark.parametrize(("table", "firings"), [(VLP_16, 3616), (OS1_64, 2048)])
def test_a_sensor_with_more_firings_than_usual_is_timed(table: LaserTable, firings: int) -> None:
    timing = scan_timing(even_scan(table, firings), table)
    assert timing.firings == pytest.approx(firings, rel=0.02) and (timing.firing >= 0).all()


def test_a_scan_with_far_too_many_firings_is_timed_by_its_azimuths() -> None:
    points = even_scan(VLP_16, 9000)
    timing = scan_timing(points, VLP_16)
    own = sweep_fraction(np.arctan2(points[:, 1], points[:, 0]))
    np.testing.assert_allclose(timing.sweep_fraction, own, atol=1e-6)
    assert timing.firings == 0 and "at most" in timing.evidence
