"""Cars that follow one another through the same places, seen by sixteen lasers, against their truth."""

import numpy as np
import pytest

from nvsf_core.demo.lidar import OWN_VEHICLE, simulate_scan
from nvsf_core.demo.motion import FRAME_PERIOD_S, EgoSpeed
from nvsf_core.demo.world import DemoWorld
from nvsf_core.evidence.moving.detection import ABOVE_GROUND_M, find_moving_objects
from nvsf_core.evidence.moving.object_evidence import MovingObjects
from nvsf_core.evidence.moving.visibility import TimedReturns
from nvsf_core.geometry.se3 import invert_pose, pose_from_parts, transform_points
from nvsf_core.sensors.sweep import Trajectory, compensate
from nvsf_core.sensors.tables import HDL_64E

FRAMES = 20
LASERS = np.arange(0, 64, 4)
SPEED = EgoSpeed(speeds_m_s=(1.5,))


@pytest.fixture(scope="module")
def traffic() -> tuple[np.ndarray, np.ndarray, MovingObjects]:
    """Which standing returns moved, which were counted at all, and what was found."""
    world = DemoWorld(5, speed=SPEED, traffic=12)
    instants = np.arange(FRAMES) * FRAME_PERIOD_S
    poses = world.lidar_to_world(instants)
    trajectory = Trajectory(instants, poses, pose_from_parts(np.eye(3), poses[0, :3, 3]))
    scans = [simulate_scan(world, frame, LASERS, 1000) for frame in range(FRAMES)]
    points = []
    for scan in scans:
        laser = LASERS[scan.laser]
        origin, direction, range_m = compensate(HDL_64E, scan.points_m, laser, scan.time_s, trajectory)
        points.append((origin + range_m[:, None] * direction).astype(np.float32))
    instance = np.concatenate([scan.instance for scan in scans])
    returns = TimedReturns(
        point_m=np.concatenate(points),
        recorded_m=np.concatenate([scan.points_m for scan in scans]),
        laser=LASERS[np.concatenate([scan.laser for scan in scans])].astype(np.int16),
        is_own_vehicle=instance == OWN_VEHICLE,
        time_s=np.concatenate([scan.time_s for scan in scans]),
        offsets=np.concatenate([[0], np.cumsum([len(scan.points_m) for scan in scans])]),
        scan_time_s=instants,
        trajectory=trajectory,
        period_s=FRAME_PERIOD_S,
        table=HDL_64E,
        elevation_correction_rad=HDL_64E.elevation_correction_rad,
    )
    to_street = invert_pose(world.street_to_world)
    height = transform_points(to_street, returns.point_m + trajectory.scene_to_world[:3, 3])[:, 2]
    counted = (height > ABOVE_GROUND_M) & ~returns.is_own_vehicle
    counted &= np.linalg.norm(returns.recorded_m, axis=1) < 80.0
    moved = np.isin(instance, [mover.object_id for mover in world.street.movers])
    return moved & counted, counted, find_moving_objects(returns)


def test_a_place_that_the_next_car_fills_was_left_all_the_same(traffic) -> None:
    moved, counted, moving = traffic
    found = (moving.object_id >= 0) & counted
    assert (found & moved).sum() / found.sum() >= 0.95
    assert (found & moved).sum() / moved.sum() >= 0.85


def test_voxels_of_objects_grow_as_returns_grow_rare(traffic) -> None:
    _, _, moving = traffic
    assert 0.2 < moving.density < 0.35
