"""Drives through the demo's street whose returns know what they met, for finding what moves."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nvsf_core.demo.lidar import OWN_VEHICLE, simulate_scan
from nvsf_core.demo.motion import FRAME_PERIOD_S, ROAD_RADIUS_M, ArcMotion, EgoSpeed
from nvsf_core.demo.shapes import ShapeList
from nvsf_core.demo.street import CAR_SIZE_M, Mover, _add_car
from nvsf_core.demo.world import DemoWorld
from nvsf_core.evidence.moving.detection import ABOVE_GROUND_M
from nvsf_core.evidence.moving.object_evidence import MovingObjects
from nvsf_core.evidence.moving.visibility import TimedReturns
from nvsf_core.geometry.se3 import invert_pose, pose_from_parts, transform_points
from nvsf_core.sensors.sweep import Trajectory, compensate
from nvsf_core.sensors.tables import HDL_64E

OTHER_LANE_M = ROAD_RADIUS_M - 2.4
"""Radius of the lane of oncoming cars."""


@dataclass(frozen=True)
class StreetDrive:
    """Returns of a drive and their truth."""

    world: DemoWorld
    returns: TimedReturns
    instance: np.ndarray
    """(N,) number of the object that each return met."""
    is_counted: np.ndarray
    """(N,) bool: above the ground and in range, and so of something that may move."""

    def is_of(self, *objects: int) -> np.ndarray:
        """(N,) bool: counted returns of these moving objects."""
        return self.is_counted & np.isin(self.instance, objects)

    def recall(self, moving: MovingObjects) -> float:
        """Share of the moving objects' counted returns that were found."""
        moved = self.is_of(*(mover.object_id for mover in self.world.street.movers))
        return float((moved & (moving.object_id >= 0)).sum() / moved.sum())

    def precision(self, moving: MovingObjects) -> float:
        """Share of the found counted returns that are of moving objects."""
        found = self.is_counted & (moving.object_id >= 0)
        moved = self.is_of(*(mover.object_id for mover in self.world.street.movers))
        return float((moved & found).sum() / found.sum())


def car(object_id: int, motion: ArcMotion) -> Mover:
    """A car of the demo's street."""
    shapes = ShapeList()
    _add_car(shapes, np.eye(4), object_id)
    return Mover(object_id, "car", motion, shapes.build(), CAR_SIZE_M)


def oncoming_car(object_id: int, speed_m_s: float, met_s: float) -> Mover:
    """A car on the other lane that a recording car of the same speed meets at an instant."""
    own_rad, its_rad = (speed_m_s * met_s / radius_m for radius_m in (ROAD_RADIUS_M + 1.05, OTHER_LANE_M))
    return car(object_id, ArcMotion(OTHER_LANE_M, own_rad + its_rad, -speed_m_s))


def street_of(movers: Sequence[Mover], *, speed_m_s: float) -> DemoWorld:
    """The demo's street with these moving objects, and a recording car of that speed."""
    world = DemoWorld(5, speed=EgoSpeed(speeds_m_s=(speed_m_s,)))
    world.street = replace(world.street, movers=tuple(movers))
    return world


def drive_through(world: DemoWorld, *, frames: int, lasers: np.ndarray, firings: int) -> StreetDrive:
    """All frames of a drive as training scans."""
    instants = np.arange(frames) * FRAME_PERIOD_S
    poses = world.lidar_to_world(instants)
    trajectory = Trajectory(instants, poses, pose_from_parts(np.eye(3), poses[0, :3, 3]))
    scans = [simulate_scan(world, frame, lasers, firings) for frame in range(frames)]
    points = []
    for scan in scans:
        laser = lasers[scan.laser]
        origin, direction, range_m = compensate(HDL_64E, scan.points_m, laser, scan.time_s, trajectory)
        points.append((origin + range_m[:, None] * direction).astype(np.float32))
    instance = np.concatenate([scan.instance for scan in scans])
    returns = TimedReturns(
        point_m=np.concatenate(points),
        recorded_m=np.concatenate([scan.points_m for scan in scans]),
        laser=lasers[np.concatenate([scan.laser for scan in scans])].astype(np.int16),
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
    return StreetDrive(world, returns, instance, counted)
