"""Lasers found from scans of the demo's writer are the table that wrote them."""

from dataclasses import fields, replace

import numpy as np
import pytest

from nvsf_core.demo.lidar import simulate_scan
from nvsf_core.demo.world import DemoWorld
from nvsf_core.drives.catalogue import load_catalogue
from nvsf_core.drives.drive import drive_of
from nvsf_core.errors import DataError
from nvsf_core.sensors.found_table import find_table
from nvsf_core.sensors.lasers import FILE_ORDER
from nvsf_core.sensors.scan_timing import RING, scan_timing
from nvsf_core.sensors.tables import ATTRIBUTE, HDL_64E, recorded_table, table_facts
from tests.conftest import SHARED

LASERS = np.arange(0, 64, 2)
FIRINGS = 700


@pytest.fixture(scope="module")
def scans():
    world = DemoWorld(0)
    return [simulate_scan(world, frame, LASERS, FIRINGS) for frame in (0, 4, 8)]


@pytest.fixture(scope="module")
def found(scans):
    return find_table([(one.points_m, None) for one in scans])


def test_the_32_lasers_of_a_scan_in_file_order_are_found(found):
    table = found.table
    assert table.laser_count == 32 and table.lattice_steps == 4000
    assert np.degrees(np.abs(table.elevation_rad - HDL_64E.elevation_rad[LASERS])).max() < 0.01
    assert np.abs(table.vertical_offset_m - HDL_64E.vertical_offset_m[LASERS]).max() < 0.001
    assert np.abs(table.horizontal_offset_m - HDL_64E.horizontal_offset_m[LASERS]).max() < 0.003
    assert len(np.unique(table.firing_shift_steps - HDL_64E.firing_shift_steps[LASERS])) == 1
    assert abs(table.firings_per_turn - FIRINGS) < 0.03 * FIRINGS
    assert "32 lasers from 3 scans, separated by the file's order" in found.evidence


def test_scans_are_timed_by_a_found_table_as_by_the_known_one(found, scans):
    timing, known = (scan_timing(scans[1].points_m, table) for table in (found.table, HDL_64E))
    assert timing.source == FILE_ORDER
    assert np.array_equal(timing.laser, known.laser // 2) and timing.firings == known.firings
    apart = np.mod(timing.sweep_fraction - known.sweep_fraction + 0.5, 1.0) - 0.5
    assert np.abs(apart).max() < 0.02


def test_rings_in_any_order_and_times_are_used(found, scans):
    one = scans[1]
    order = np.random.default_rng(0).permutation(len(one.points_m))
    points_m, ring = one.points_m[order], 31 - one.laser[order]
    made = find_table([(points_m, ring)]).table
    assert np.degrees(np.abs(made.elevation_rad - found.table.elevation_rad)).max() < 0.02
    offset_s = one.time_s[order] - 0.4
    timing = scan_timing(points_m, made, ring=ring, offset_s=offset_s, period_s=0.1)
    assert timing.source == RING and np.array_equal(timing.laser, one.laser[order])
    assert np.allclose(timing.elapsed, 10.0 * offset_s) and timing.share_beside_clock == 0.0


def test_rings_that_are_not_lasers_are_not_believed(scans):
    one = scans[0]
    ring = np.arange(len(one.points_m)) % 32
    timing = scan_timing(one.points_m, HDL_64E, ring=ring)
    assert timing.source == FILE_ORDER and "not believed" in timing.evidence


@pytest.mark.parametrize("lost", [0, 16, 31], ids=["top", "middle", "lowest"])
@pytest.mark.parametrize("is_alone", [False, True], ids=["among all", "without its neighbours"])
def test_a_ring_without_a_laser_in_the_table_leaves_the_others_believed(scans, lost, is_alone):
    one = scans[0]
    names = [each.name for each in fields(HDL_64E) if isinstance(getattr(HDL_64E, each.name), np.ndarray)]
    rows = np.delete(LASERS, lost)
    table = replace(HDL_64E, **{name: getattr(HDL_64E, name)[rows] for name in names})
    beside = np.abs(one.laser - lost) == 1
    kept = ~beside if is_alone else np.ones(len(beside), np.bool_)
    points_m, ring = one.points_m[kept], one.laser[kept]
    timing = scan_timing(points_m, table, ring=ring)
    assert timing.source == RING and "1 of them without a laser in the table" in timing.evidence
    of_ring = np.insert(np.arange(31), lost, -1)
    assert np.array_equal(timing.laser, of_ring[ring])


def test_points_without_order_and_ring_are_refused_with_what_to_do(scans):
    shuffled = np.random.default_rng(0).permutation(scans[0].points_m)
    with pytest.raises(DataError, match=r"expected 90%; name the sensor \(`lidar` of the scene\)"):
        find_table([(shuffled, None)])


def test_rings_of_too_few_returns_are_the_reason_and_rings_are_not_asked_for_again(scans):
    few = [(one.points_m[::200], one.laser[::200]) for one in scans]
    reason = r"their `ring`, 32 with fewer than 30 returns each: expected 30 returns of a .* in 5 scans"
    with pytest.raises(DataError, match=reason) as refused:
        find_table(few[:1], [*few[1:], *few[:2]])
    assert str(refused.value).endswith("name the sensor (`lidar` of the scene)")


def test_rings_of_few_returns_refuse_no_drive_and_are_sought_in_its_other_scans(found, scans):
    few = [(one.points_m[::65], one.laser[::65]) for one in scans]
    alone = find_table(few)
    assert 5 < alone.table.laser_count < 32
    assert f"{32 - alone.table.laser_count} with fewer than 30 returns each: " in alone.evidence
    whole = [(one.points_m, one.laser) for one in scans]
    made = find_table(few, whole)
    assert np.degrees(np.abs(made.table.elevation_rad - found.table.elevation_rad)).max() < 0.02
    assert f"`ring`, {32 - alone.table.laser_count} of them in all 6 scans: " in made.evidence
    assert made.evidence.endswith("none left out")
    # Returns in other scans are no further firings of these.
    assert made.table.firings_per_turn == alone.table.firings_per_turn < FIRINGS // 10


def test_an_evenly_spaced_sensor_without_lever_arms_is_told_apart_by_elevation():
    rng = np.random.default_rng(0)
    elevation = np.radians(np.arange(15.0, -16.0, -2.0))
    azimuth, rise = np.meshgrid(np.arange(900) * 2.0 * np.pi / 900, elevation)
    range_m = rng.uniform(12.0, 60.0, azimuth.shape)
    flat = range_m * np.cos(rise)
    points_m = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), range_m * np.sin(rise)], axis=-1)
    shuffled = rng.permutation(points_m.reshape(-1, 3).astype(np.float32))
    made = find_table([(shuffled, None)])
    assert np.abs(made.table.elevation_rad - elevation).max() < 1e-4
    assert not made.table.firing_shift_steps.any()
    assert made.table.lattice_steps == 900 and made.table.firings_per_turn == 900
    assert np.abs(made.table.horizontal_offset_m).max() < 0.003
    assert "gaps between their elevations" in made.evidence


@pytest.mark.parametrize("is_clockwise", [False, True], ids=["ascending", "descending"])
def test_lasers_of_a_file_whose_rows_begin_behind_are_found_and_told(found, scans, is_clockwise):
    clouds = []
    for one in scans:
        azimuth = np.arctan2(one.points_m[:, 1], one.points_m[:, 0])
        order = np.lexsort((-azimuth if is_clockwise else azimuth, one.laser))
        clouds.append((one.points_m[order], one.laser[order]))
    made = find_table([(points_m, None) for points_m, _ in clouds])
    assert "32 lasers from 3 scans, separated by the file's order" in made.evidence
    assert np.degrees(np.abs(made.table.elevation_rad - found.table.elevation_rad)).max() < 0.01
    for points_m, laser in clouds:
        timing = scan_timing(points_m, made.table)
        assert timing.source == FILE_ORDER
        assert np.mean(timing.laser == laser) > 0.999


def test_steep_lasers_that_see_only_the_road_near_by_are_told_apart_by_elevation():
    elevation = np.radians(np.arange(8.0, -26.0, -2.0))
    azimuth, rise = np.meshgrid(np.arange(900) * 2.0 * np.pi / 900, elevation)
    wall_m = np.random.default_rng(0).uniform(12.0, 60.0, azimuth.shape)
    range_m = np.minimum(wall_m, 1.8 / np.maximum(-np.sin(rise), 1e-9))
    flat = range_m * np.cos(rise)
    points_m = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), range_m * np.sin(rise)], axis=-1)
    firing_after_firing = points_m.swapaxes(0, 1).reshape(-1, 3).astype(np.float32)
    made = find_table([(firing_after_firing, None)])
    assert "17 lasers" in made.evidence and "gaps between their elevations" in made.evidence
    assert np.abs(made.table.elevation_rad - elevation).max() < 1e-4


@pytest.mark.parametrize("begins", [(0.3,) * 3, (0.05, 0.9, 0.8), (0.1, 0.45, 0.75)])
def test_a_sensor_that_begins_each_sweep_anywhere_has_no_lattice(begins):
    columns, rings = np.arange(720), np.arange(16)
    laser, column = (one.ravel() for one in np.meshgrid(rings, columns, indexing="ij"))
    elevation = np.radians(2.0 * laser - 15.0)
    range_m = np.random.default_rng(1).uniform(5.0, 40.0, len(laser))

    def scan(begin):
        azimuth = 2.0 * np.pi * (column + begin) / len(columns)
        flat_m = range_m * np.cos(elevation)
        rows = np.stack([flat_m * np.cos(azimuth), flat_m * np.sin(azimuth), range_m * np.sin(elevation)], 1)
        return rows.astype(np.float32), laser

    said = find_table([scan(begin) for begin in begins]).evidence
    assert ("no encoder's lattice" in said) == (len(set(begins)) > 1)


@pytest.mark.parametrize("columns", [30, 720])
def test_lasers_that_fire_together_between_two_steps_fire_together_in_the_table(columns):
    laser, column = (one.ravel() for one in np.meshgrid(np.arange(16), np.arange(columns), indexing="ij"))
    elevation = np.radians(15.0 - 2.0 * laser)
    range_m = np.random.default_rng(1).uniform(12.0, 40.0, len(laser))
    azimuth = 2.0 * np.pi * (column + 0.5) / columns
    flat_m = range_m * np.cos(elevation)
    rows = np.stack([flat_m * np.cos(azimuth), flat_m * np.sin(azimuth), range_m * np.sin(elevation)], 1)
    table = find_table([(rows.astype(np.float32), laser)] * 2).table
    assert np.ptp(table.phase_steps - table.firing_shift_steps) < 0.1, (
        "not half a step for one, -0.5 for others"
    )
    assert np.abs(table.phase_steps).max() == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize("lasers", [1, 16])
def test_a_sensor_most_of_whose_rays_are_lost_fires_at_every_step_all_the_same(lasers):
    rng = np.random.default_rng(2)
    laser, column = (one.ravel() for one in np.meshgrid(np.arange(lasers), np.arange(720), indexing="ij"))
    azimuth, elevation = 2.0 * np.pi * column / 720, -np.radians(1.0 + laser)

    def scan():
        range_m = rng.uniform(12.0, 40.0, len(laser))
        flat_m = range_m * np.cos(elevation)
        rows = np.stack([flat_m * np.cos(azimuth), flat_m * np.sin(azimuth), range_m * np.sin(elevation)], 1)
        kept = rng.uniform(size=len(laser)) < 0.4
        return rows[kept].astype(np.float32), laser[kept]

    table = find_table([scan() for _ in range(4)]).table
    assert table.lattice_steps == table.firings_per_turn == 720


@pytest.mark.parametrize("name", ["k360_street", "kitti0005_van_cyclist"])
def test_the_lasers_of_real_scans_are_the_measured_table(name):
    if not (SHARED / "data/scenes.toml").is_file():
        pytest.skip("no real drives beside the checkout")
    (entry,) = (one for one in load_catalogue([SHARED / "data/scenes.toml"], None) if one.name == name)
    drive = drive_of(entry)
    table = find_table([(drive.read_scan(frame).points[:, :3], None) for frame in drive.frames[::7]]).table
    assert table.laser_count == 64 and table.lattice_steps == HDL_64E.lattice_steps
    assert np.degrees(np.abs(table.elevation_rad - HDL_64E.elevation_rad)).max() < 0.1
    assert np.abs(table.vertical_offset_m - HDL_64E.vertical_offset_m).max() < 0.01
    assert np.abs(table.horizontal_offset_m - HDL_64E.horizontal_offset_m).max() < 0.003
    assert len(np.unique(table.firing_shift_steps - HDL_64E.firing_shift_steps)) == 1


def test_a_found_table_is_stored_and_read_back(found):
    read = recorded_table({"sensor": found.table.name, ATTRIBUTE: table_facts(found.table)})
    assert read.name == "found-32" and read.firing_shift_steps.dtype == np.int64
    assert np.array_equal(read.phase_steps, found.table.phase_steps)
    assert recorded_table({"sensor": "HDL-64E"}) is HDL_64E
