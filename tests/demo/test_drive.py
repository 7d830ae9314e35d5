import hashlib
import signal
import sys

import numpy as np
import pytest

from nvsf_core.demo.drive import DEMO_SEQUENCE, DemoSize, write_demo
from nvsf_core.demo.lidar import OWN_VEHICLE, RANGE_NOISE_M, simulate_scan
from nvsf_core.demo.motion import ROAD_RADIUS_M
from nvsf_core.demo.shapes import Kind
from nvsf_core.demo.street import KERB_HEIGHT_M, ROAD_HALF_WIDTH_M, Material
from nvsf_core.demo.world import DemoWorld
from nvsf_core.drives.kitti360.boxes import read_boxes
from nvsf_core.drives.kitti360.calibration import read_calibration
from nvsf_core.drives.kitti360.frames import compare_poses, read_cam0_to_world, read_poses
from nvsf_core.drives.kitti360.layout import DriveLayout
from nvsf_core.errors import DataError, ShapeError
from nvsf_core.geometry.se3 import invert_pose
from nvsf_core.sensors.beam_table import encoder_angle, recorded_ray_of_points, turn_up
from nvsf_core.sensors.lasers import FILE_ORDER
from nvsf_core.sensors.scan_timing import scan_timing
from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.sensors.tables import HDL_64E


@pytest.fixture(scope="module")
def world():
    return DemoWorld(0)


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    root = tmp_path_factory.mktemp("demo") / "drive"
    told = []
    write_demo(root, size=DemoSize.tiny(), progress=lambda done, total: told.append((done, total)))
    assert told == [(1, 4), (2, 4), (3, 4), (4, 4)]
    return DriveLayout(root, DEMO_SEQUENCE)


def digest(root):
    files = sorted(path for path in root.rglob("*") if path.is_file())
    return {str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def spread_rays(world, count, time_s, seed=1):
    """Rays from the recording LiDAR's place into all directions, as far as it sees up and down."""
    rng = np.random.default_rng(seed)
    azimuth, elevation = rng.uniform(-np.pi, np.pi, count), np.deg2rad(rng.uniform(-25, 15, count))
    directions = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1
    )
    origin = world.lidar_to_world(np.array([time_s]))[0, :3, 3]
    turn = world.street_to_world[:3, :3]
    return np.broadcast_to(origin, directions.shape), directions @ turn.T, np.full(count, time_s)


def in_street(world, points_m):
    to_street = invert_pose(world.street_to_world)
    return points_m @ to_street[:3, :3].T + to_street[:3, 3]


def test_tiny_drive_has_every_file_a_reader_wants(drive):
    assert len(list(drive.velodyne_dir.glob("data/*.bin"))) == 4
    assert len(list(drive.camera_dir("image_00").glob("*.png"))) == 4
    assert sorted(read_poses(drive.poses_path)) == [0, 1, 2, 3]
    assert len(drive.timestamps_path().read_text().splitlines()) == 4
    assert len(drive.boxes_paths) == 1
    assert not list(drive.root.parent.glob(".*"))


def test_calibration_and_both_pose_files_agree(drive, world):
    calibration = read_calibration(drive, None, has_scans=True)
    poses = read_poses(drive.poses_path)
    camera = calibration.cameras["image_00"]
    from_poses = {frame: pose @ camera.to_pose for frame, pose in poses.items()}
    apart = compare_poses(from_poses, read_cam0_to_world(drive.cam0_to_world_path))
    assert apart.frames == 4 and apart.translation_m < 1e-6 and apart.rotation_deg < 1e-4
    lidar = np.stack([pose @ calibration.lidar_to_pose for pose in poses.values()])
    assert np.allclose(lidar, world.lidar_to_world(np.arange(4) * 0.1), atol=1e-6)


def test_same_seed_same_bytes_another_seed_another_street(drive, tmp_path):
    (tmp_path / "same").mkdir()  # an empty folder is no drive
    write_demo(tmp_path / "same", size=DemoSize.tiny(), seed=0)
    write_demo(tmp_path / "other", size=DemoSize.tiny(), seed=1)
    assert digest(tmp_path / "same") == digest(drive.root)
    assert digest(tmp_path / "other") != digest(drive.root)


def test_an_existing_drive_is_never_overwritten(drive):
    with pytest.raises(DataError, match="remove"):
        write_demo(drive.root, size=DemoSize.tiny())


KILLED = """
import os, signal, sys
from pathlib import Path
from nvsf_core.demo.drive import DemoSize, write_demo
kill = lambda done, total: os.kill(os.getpid(), signal.SIGKILL)
write_demo(Path(sys.argv[1]), size=DemoSize.tiny(), progress=kill)
"""


def test_what_a_killed_writer_left_goes_with_the_next_one(run_process, tmp_path):
    root = tmp_path / "drives/demo"
    assert run_process(sys.executable, "-c", KILLED, str(root)).returncode == -signal.SIGKILL
    (left,) = root.parent.iterdir()
    assert left.name.startswith(".publishing-demo-")
    write_demo(root, size=DemoSize.tiny())
    assert [path.name for path in root.parent.iterdir()] == ["demo"]


def test_car_drives_8_to_10_m_s_far_from_the_origin(world):
    position = world.lidar_to_world(np.arange(32) * 0.1)[:, :3, 3]
    speed = np.linalg.norm(np.diff(position, axis=0), axis=1) / 0.1
    assert speed.min() > 8.0 and speed.max() < 10.0
    assert np.linalg.norm(position - (1000, 3700, 115), axis=1).max() < 35.0


def test_ground_hits_lie_on_the_ground(world):
    origins, directions, times = spread_rays(world, 20000, 0.7)
    hits = world.cast(origins, directions, times)
    range_m = np.where(hits.material == Material.SKY, 0.0, hits.range_m)
    place = in_street(world, origins + range_m[:, None].astype(np.float64) * directions)
    radius = np.hypot(place[:, 0], place[:, 1])
    road = np.isin(hits.material, (Material.ASPHALT, Material.MARKING))
    walk = hits.material == Material.PAVEMENT
    kerb = (hits.material == Material.KERB) & (hits.instance == 0)
    near = hits.range_m < 80
    assert road.sum() > 3000 and walk.sum() > 500 and kerb.sum() > 50
    assert np.abs(place[road & near, 2]).max() < 1e-3
    assert np.abs(radius[road] - ROAD_RADIUS_M).max() < ROAD_HALF_WIDTH_M + 1e-3
    assert np.abs(place[walk & near, 2] - KERB_HEIGHT_M).max() < 1e-3
    assert np.abs(np.abs(radius[kerb & near] - ROAD_RADIUS_M) - ROAD_HALF_WIDTH_M).max() < 1e-3


def test_culled_casting_matches_brute_force_over_all_shapes(world):
    origins, directions, times = spread_rays(world, 300, 1.6, seed=4)
    hits = world.cast(origins, directions, times)
    shapes = world.street.shapes
    turn = invert_pose(world.street_to_world)[:3, :3]
    start, along = in_street(world, origins), directions @ turn.T
    nearest = np.full(len(start), np.inf)
    for kind, centre, axes, half in zip(
        shapes.kind, shapes.centre_m.astype(float), shapes.axes.astype(float), shapes.half_m.astype(float),
        strict=True,
    ):  # fmt: skip
        nearest = np.minimum(
            nearest, first_hit_brute_force(kind, (start - centre) @ axes.T / half, along @ axes.T / half)
        )
    # Ground, leaves and moving things may stand before a shape; nothing may be missed or invented.
    of_shapes = np.isin(hits.instance, shapes.instance) & (hits.material != Material.LEAF)
    assert of_shapes.sum() > 80
    assert np.allclose(hits.range_m[of_shapes], nearest[of_shapes], atol=2e-3)
    assert (hits.range_m[~of_shapes] <= nearest[~of_shapes] + 2e-3).all()


def first_hit_brute_force(kind, start, along):
    """Entry into one unit shape, float64, straight from the textbook."""
    with np.errstate(divide="ignore", invalid="ignore"):
        if kind == Kind.ELLIPSOID:
            a, b, c = (along**2).sum(1), (start * along).sum(1), (start**2).sum(1) - 1
            entry = (-b - np.sqrt(b**2 - a * c)) / a
            return np.where(np.isnan(entry) | (entry <= 0), np.inf, entry)
        first = np.minimum((-1 - start) / along, (1 - start) / along)
        last = np.maximum((-1 - start) / along, (1 - start) / along)
        if kind == Kind.CYLINDER:
            a, b = (along[:, :2] ** 2).sum(1), (start[:, :2] * along[:, :2]).sum(1)
            root = np.sqrt(b**2 - a * ((start[:, :2] ** 2).sum(1) - 1))
            first = np.stack([(-b - root) / a, first[:, 2]], axis=1)
            last = np.stack([(-b + root) / a, last[:, 2]], axis=1)
        entry, leave = first.max(axis=1), last.min(axis=1)
        return np.where((entry <= leave) & (entry > 0), entry, np.inf)


def test_leaves_lie_inside_their_crowns_and_rays_pass_between_them(world):
    crowns = world.street.crowns
    target = world.street_to_world[:3, :3] @ crowns.centre_m[::2].astype(float).T
    target = target.T + world.street_to_world[:3, 3]
    rng = np.random.default_rng(0)
    goal = np.repeat(target, 200, axis=0) + rng.uniform(-1, 1, (len(target) * 200, 3))
    origin = goal + np.array([0.0, 0.0, 30.0])
    down = np.broadcast_to([0.0, 0.0, -1.0], origin.shape)
    hits = world.cast(origin, down, np.zeros(len(origin)))
    leaf = hits.material == Material.LEAF
    assert 0.3 < leaf.mean() < 0.95
    place = in_street(world, origin + hits.range_m[:, None].astype(float) * down)[leaf]
    away = np.linalg.norm(place[:, None] - crowns.centre_m, axis=2) - crowns.radius_m
    assert away.min(axis=1).max() < 1e-3


def test_order_of_rays_does_not_matter(world):
    origins, directions, times = spread_rays(world, 3000, 1.1, seed=2)
    order = np.random.default_rng(0).permutation(3000)
    whole = world.cast(origins, directions, times)
    mixed = world.cast(origins[order], directions[order], times[order])
    assert np.allclose(whole.range_m[order], mixed.range_m, atol=1e-3)


def test_mismatched_rays_are_refused(world):
    with pytest.raises(ShapeError):
        world.cast(np.zeros((3, 3)), np.zeros((4, 3)), np.zeros(3))


def test_moving_object_is_met_where_it_is_at_the_rays_own_time(world):
    for mover in world.street.movers:
        times = np.linspace(0.0, 3.1, 50)
        pose = world.object_to_world(mover.object_id, times)
        centre = pose[:, :3, 3] + 0.62 * pose[:, :3, 2]
        # From a point beside the road's middle line, at the height of the body, straight at the centre.
        origin = centre + 2.0 * pose[:, :3, 2] + 3.0 * pose[:, :3, 0]
        direction = centre - origin
        length = np.linalg.norm(direction, axis=1)
        hits = world.cast(origin, direction / length[:, None], times)
        assert (hits.instance == mover.object_id).all()
        assert (hits.range_m < length).all()
        late = world.cast(origin, direction / length[:, None], times + 1.0)
        assert (late.instance != mover.object_id).all()


def test_movers_move_and_are_seen_in_three_scans_or_more(world):
    for mover in world.street.movers:
        path = world.object_to_world(mover.object_id, np.array([0.0, 3.1]))[:, :3, 3]
        assert np.linalg.norm(path[1] - path[0]) > 0.5
    scans = [simulate_scan(world, frame, np.arange(0, 64, 3), 1050) for frame in (2, 10, 18, 26)]
    for mover in world.street.movers:
        assert all((scan.instance == mover.object_id).sum() > 5 for scan in scans)


def test_boxes_hold_the_moving_objects_points(world, drive):
    boxes = [box for box in read_boxes(drive.boxes_paths[0], 0, 3)[0] if box.dynamic]
    assert len(boxes) == 2 * 4
    scan = simulate_scan(world, 3, np.arange(64), 1050)
    points = recorded_to_world(world, scan.points_m, scan.time_s)
    for mover, box in zip(world.street.movers, [b for b in boxes if b.frame == 3], strict=True):
        mine = scan.instance == mover.object_id
        # Follow each point to the box's own instant before asking whether it lies inside.
        then, now = (world.object_to_world(mover.object_id, t) for t in (scan.time_s[mine], np.array([0.3])))
        carried = now @ invert_pose(then) @ np.c_[points[mine], np.ones(mine.sum())][..., None]
        unit = (np.linalg.inv(box.box_to_world) @ carried)[:, :3, 0]
        margin = 5 * RANGE_NOISE_M / np.linalg.norm(box.box_to_world[:3, :3], axis=0)
        inside = (np.abs(unit) < 0.5 + margin).all(axis=1)
        assert mine.sum() > 20
        # What is left are mixed pixels between the object and what stands behind it.
        assert inside.mean() > 0.9


def recorded_to_world(world, points_m, time_s):
    """As an ingest does it: turn up by the correction in the azimuth's plane, then place at the own time."""
    azimuth = np.arctan2(points_m[:, 1], points_m[:, 0])
    flat, up = np.hypot(points_m[:, 0], points_m[:, 1]), points_m[:, 2]
    angle = HDL_64E.elevation_correction_rad
    ahead, up = flat * np.cos(angle) - up * np.sin(angle), flat * np.sin(angle) + up * np.cos(angle)
    turned = np.stack([ahead * np.cos(azimuth), ahead * np.sin(azimuth), up, np.ones_like(up)], axis=-1)
    return (world.lidar_to_world(time_s) @ turned[..., None])[:, :3, 0]


def test_recorded_ground_returns_land_on_the_road_by_the_ingest_rules(world):
    scan = simulate_scan(world, 5, np.arange(64), 525)
    fraction = scan_timing(scan.points_m, HDL_64E).sweep_fraction
    time_s = 0.5 + fraction * 0.1
    assert np.abs(time_s - scan.time_s).max() < 1e-6
    street = in_street(world, recorded_to_world(world, scan.points_m.astype(float), time_s))
    radius = np.hypot(street[:, 0], street[:, 1])
    road = (
        (scan.instance == 0)
        & (np.abs(radius - ROAD_RADIUS_M) < 5.0)
        & (np.linalg.norm(scan.points_m, axis=1) < 20)
    )
    assert road.sum() > 2000
    assert abs(np.median(street[road, 2])) < 1e-3
    assert np.abs(street[road, 2]).mean() < RANGE_NOISE_M


def test_recorded_ranges_are_the_worlds_along_the_ingested_rays(world):
    # Through the project's own ingest: lasers and times from the file alone, motion from the frames' poses.
    frame, times_s = 5, np.arange(12) * 0.1
    scan = simulate_scan(world, frame, np.arange(64), 1050)
    timing = scan_timing(scan.points_m, HDL_64E)
    assert timing.source == FILE_ORDER and np.array_equal(timing.laser, scan.laser)
    origin, direction, range_m = recorded_ray_of_points(HDL_64E, scan.points_m, timing.laser)
    theta = encoder_angle(HDL_64E, scan.points_m, timing.laser)
    origin, direction = turn_up(origin, direction, theta, HDL_64E.elevation_correction_rad)
    path = Trajectory(times_s, world.lidar_to_world(times_s), np.eye(4))
    time_s = times_s[frame] + timing.sweep_fraction * 0.1
    origin, direction = path.move_rays(origin, direction, time_s)
    truth = world.cast(origin, direction, time_s).range_m
    error = np.where(np.isfinite(truth), range_m - truth, np.inf)[scan.instance != OWN_VEHICLE]
    assert abs(np.median(error)) < 2e-3
    assert np.median(np.abs(error)) < RANGE_NOISE_M
    assert (np.abs(error) < 5 * RANGE_NOISE_M).mean() > 0.9


def test_scan_is_laser_by_laser_with_ascending_azimuth(world):
    scan = simulate_scan(world, 2, np.arange(64), 525)
    azimuth = np.mod(np.arctan2(scan.points_m[:, 1], scan.points_m[:, 0]).astype(float), 2 * np.pi)
    assert (np.diff(scan.laser) >= 0).all()
    assert (np.diff(azimuth)[np.diff(scan.laser) == 0] >= 0).all()
    assert (np.diff(azimuth) < -np.pi / 2).sum() == 63
    assert np.array_equal(np.unique(scan.laser), np.arange(64))
    assert scan.intensity.min() >= 0 and scan.intensity.max() <= 0.99
    assert np.linalg.norm(scan.points_m, axis=1).max() < 80.5


def test_nearer_than_two_and_a_half_metres_is_only_the_own_vehicle(world):
    for frame in (0, 16, 31):
        scan = simulate_scan(world, frame, np.arange(64), 1050)
        near = np.linalg.norm(scan.points_m, axis=1) < 2.5
        assert near.sum() > 30
        assert (scan.instance[near] == OWN_VEHICLE).all()
