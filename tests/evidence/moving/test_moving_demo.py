"""What moves on the demo street, against its analytic truth; training scans only, nothing labelled."""

import numpy as np
import pytest

from nvsf_core.demo.lidar import OWN_VEHICLE, simulate_scan
from nvsf_core.demo.motion import FRAME_PERIOD_S
from nvsf_core.demo.world import DemoWorld
from nvsf_core.evidence.moving.detection import ABOVE_GROUND_M, find_moving_objects
from nvsf_core.evidence.moving.object_evidence import MovingObjects, boxes_on_way
from nvsf_core.evidence.moving.objects import prove_objects
from nvsf_core.evidence.moving.visibility import TimedReturns
from nvsf_core.evidence.surfels import build_surfels
from nvsf_core.geometry.se3 import invert_pose, pose_from_parts, transform_points
from nvsf_core.rendering.reproject import reproject_rays
from nvsf_core.sensors.sweep import Trajectory, compensate
from nvsf_core.sensors.tables import HDL_64E

FRAMES = tuple(frame for frame in range(10, 22) if frame != 15)
"""Frame 15 is held out; the car comes by."""
LASERS = np.arange(64)
FIRINGS = 1000


def demo_returns() -> tuple[TimedReturns, np.ndarray, DemoWorld]:
    """The small demo's training returns, and which object (N,) each met."""
    world = DemoWorld(0)
    instants = np.arange(FRAMES[-1] + 1) * FRAME_PERIOD_S
    poses = world.lidar_to_world(instants)
    trajectory = Trajectory(instants, poses, pose_from_parts(np.eye(3), poses[0, :3, 3]))
    scans = [simulate_scan(world, frame, LASERS, FIRINGS) for frame in FRAMES]
    points = []
    for scan in scans:
        laser = LASERS[scan.laser]
        origin, direction, range_m = compensate(HDL_64E, scan.points_m, laser, scan.time_s, trajectory)
        points.append((origin + range_m[:, None] * direction).astype(np.float32))
    returns = TimedReturns(
        point_m=np.concatenate(points),
        recorded_m=np.concatenate([scan.points_m for scan in scans]),
        laser=LASERS[np.concatenate([scan.laser for scan in scans])].astype(np.int16),
        is_own_vehicle=np.concatenate([scan.instance for scan in scans]) == OWN_VEHICLE,
        time_s=np.concatenate([scan.time_s for scan in scans]),
        offsets=np.concatenate([[0], np.cumsum([len(scan.points_m) for scan in scans])]),
        scan_time_s=instants[list(FRAMES)],
        trajectory=trajectory,
        period_s=FRAME_PERIOD_S,
        table=HDL_64E,
        elevation_correction_rad=HDL_64E.elevation_correction_rad,
    )
    return returns, np.concatenate([scan.instance for scan in scans]), world


@pytest.fixture(scope="module")
def street() -> tuple[TimedReturns, np.ndarray, DemoWorld, MovingObjects]:
    returns, instance, world = demo_returns()
    return returns, instance, world, find_moving_objects(returns)


def test_what_moves_is_found_and_what_stands_is_not(street) -> None:
    returns, instance, world, moving = street
    to_street = invert_pose(world.street_to_world)
    height = transform_points(to_street, returns.point_m + returns.trajectory.scene_to_world[:3, 3])[:, 2]
    above_ground = (height > ABOVE_GROUND_M) & ~returns.is_own_vehicle
    truth = np.isin(instance, [mover.object_id for mover in world.street.movers])
    found = moving.object_id >= 0
    hits = (truth & found & above_ground).sum()
    assert hits / (found & above_ground).sum() >= 0.95
    assert hits / (truth & above_ground).sum() >= 0.95


def test_centres_move_as_they_did_to_two_centimetres_a_frame(street) -> None:
    returns, instance, world, moving = street
    for mover in world.street.movers:
        own = moving.object_id[(instance == mover.object_id) & (moving.object_id >= 0)]
        found = moving.objects[np.bincount(own).argmax()]
        time_s = returns.scan_time_s[found.scan]
        truth = world.object_to_world(mover.object_id, time_s)
        centre = (
            truth[:, :3, 3]
            + 0.5 * mover.size_m[2] * truth[:, :3, 2]
            - returns.trajectory.scene_to_world[:3, 3]
        )
        in_object = found.to_object(centre, time_s)
        pose = found.matrix_at(time_s)[1:]
        predicted = np.einsum("nij,nj->ni", pose[:, :3, :3], in_object[:-1]) + pose[:, :3, 3]
        frames = np.diff(time_s) / FRAME_PERIOD_S
        error_m = np.linalg.norm(predicted - centre[1:], axis=1) / frames
        assert np.median(error_m) <= 0.02


def test_boxes_lie_around_what_moves_and_along_its_way(street) -> None:
    returns, _, world, moving = street
    _, fired_from = returns.trajectory.at(returns.time_s)
    along = returns.point_m - fired_from
    range_m = np.linalg.norm(along, axis=1)
    rays = (
        fired_from.astype(np.float32), (along / range_m[:, None]).astype(np.float32),
        range_m.astype(np.float32), np.zeros(len(range_m), np.float32),
    )  # fmt: skip
    found = prove_objects(moving, *rays, returns.time_s, returns.offsets)
    for mover in world.street.movers:
        errors = []
        for one in found:
            boxes = boxes_on_way(one)
            truth = world.object_to_world(mover.object_id, one.path.time_s)
            middle = truth[:, :3, 3] + 0.5 * mover.size_m[2] * truth[:, :3, 2]
            away_m = np.linalg.norm(
                boxes[:, :2, 3] + returns.trajectory.scene_to_world[:2, 3] - middle[:, :2], axis=1
            )
            ahead = boxes[:, :3, 0] / np.linalg.norm(boxes[:, :3, 0], axis=1, keepdims=True)
            errors.append((np.median(away_m), np.median((ahead * truth[:, :3, 0]).sum(axis=1))))
        away_m, cosine = min(errors)
        assert away_m < 0.5 and cosine > np.cos(np.deg2rad(12.0)), mover.label


def test_the_same_returns_give_the_same_objects(street) -> None:
    returns, _, _, moving = street
    again = find_moving_objects(returns)
    assert np.array_equal(again.object_id, moving.object_id)
    assert all(np.array_equal(a.pose, b.pose) for a, b in zip(again.objects, moving.objects, strict=True))


@pytest.mark.parametrize("scans", [0, 1, 2])
def test_too_few_scans_show_no_motion(street, scans: int) -> None:
    returns = street[0]
    end = returns.offsets[scans]
    few = TimedReturns(
        returns.point_m[:end], returns.recorded_m[:end], returns.laser[:end], returns.is_own_vehicle[:end],
        returns.time_s[:end], returns.offsets[: scans + 1], returns.scan_time_s[:scans], returns.trajectory,
        returns.period_s, returns.table, returns.elevation_correction_rad,
    )  # fmt: skip
    moving = find_moving_objects(few)
    assert moving.is_static
    assert moving.object_id.shape == (end,)


def test_unknown_lasers_show_no_motion(street) -> None:
    returns = street[0]
    blind = TimedReturns(
        returns.point_m, returns.recorded_m, np.full_like(returns.laser, -1), returns.is_own_vehicle,
        returns.time_s, returns.offsets, returns.scan_time_s, returns.trajectory, returns.period_s,
        returns.table, returns.elevation_correction_rad,
    )  # fmt: skip
    assert find_moving_objects(blind).is_static


@pytest.mark.parametrize("shaped", [False, True])
def test_rays_of_the_left_out_scan_meet_what_stands_within_two_centimetres(street, shaped) -> None:
    returns, _, world, moving = street
    stays = (moving.object_id < 0) & ~returns.is_own_vehicle
    _, fired_from = returns.trajectory.at(returns.time_s[stays])
    along = returns.point_m[stays] - fired_from
    range_m = np.linalg.norm(along, axis=1)
    surfels = build_surfels(
        fired_from.astype(np.float32), (along / range_m[:, None]).astype(np.float32),
        range_m.astype(np.float32), np.zeros(len(range_m)), voxel_m=0.2, has_shapes=shaped,
    )  # fmt: skip
    scan = simulate_scan(world, 15, LASERS, FIRINGS)
    origin, direction, _ = compensate(
        HDL_64E, scan.points_m, LASERS[scan.laser], scan.time_s, returns.trajectory
    )
    stood = ~np.isin(scan.instance, [OWN_VEHICLE, *(mover.object_id for mover in world.street.movers)])
    found = reproject_rays(
        surfels, origin[stood].astype(np.float32), direction[stood].astype(np.float32),
        np.ones(int(stood.sum()), np.float32), most=24, far_m=120.0,
    )  # fmt: skip
    error_m = np.abs(found.range_m - scan.true_range_m[stood])
    assert np.isfinite(error_m).mean() > 0.99
    assert np.median(error_m) <= 0.02
