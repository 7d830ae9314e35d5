"""A person who walks through the demo's street with swinging legs and arms, as 64 lasers see them."""

from dataclasses import dataclass, replace

import numpy as np

from nvsf_core.demo.motion import ROAD_RADIUS_M, ArcMotion, EgoSpeed
from nvsf_core.demo.shapes import Kind, ShapeList
from nvsf_core.demo.street import Material, Mover
from nvsf_core.demo.world import DemoWorld
from nvsf_core.evidence.moving.object_evidence import MovingObject, ObjectEvidence, ObjectRays
from nvsf_core.geometry.se3 import exp_so3, invert_pose, pose_from_parts, transform_points
from nvsf_core.sensors.tables import HDL_64E

FRAME_S = 0.1
PERSON = 900
_STEPS_HZ = 0.95
_AZIMUTHS_RAD = np.deg2rad(np.arange(-6.0, 6.0, 0.171))
_BODY = ((0.0, 0.0, 1.2), (0.14, 0.22, 0.36)), ((0.0, 0.0, 1.65), (0.1, 0.1, 0.14))
_LEG, _ARM = ((0.0, 0.0, -0.45), (0.09, 0.08, 0.46)), ((0.0, 0.0, -0.33), (0.06, 0.06, 0.34))


@dataclass(frozen=True)
class Swing(ArcMotion):
    """A limb's motion: about a joint of somebody who walks along an arc."""

    joint_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    amplitude_rad: float = 0.0
    phase_rad: float = 0.0

    def pose(self, times_s: np.ndarray) -> np.ndarray:
        angle = self.amplitude_rad * np.sin(2 * np.pi * _STEPS_HZ * np.asarray(times_s) + self.phase_rad)
        turn = exp_so3(np.column_stack([0 * angle, angle, 0 * angle]))
        return ArcMotion.pose(self, times_s) @ pose_from_parts(turn, np.tile(self.joint_m, (len(angle), 1)))


@dataclass(frozen=True)
class Walk:
    """A person in the demo's street."""

    world: DemoWorld
    body: ArcMotion
    evidence: ObjectEvidence
    """With the body's true path."""


def walk_past(amplitude_rad: float, scans: int) -> Walk:
    """A person who is seen in some scans; with an amplitude of 0 the limbs are stiff."""
    base = ArcMotion(ROAD_RADIUS_M + 3.5, 0.07, 1.4)
    movers = [_part(base, *_BODY)]
    for side in (-1.0, 1.0):
        for limb, joint, swing in ((_LEG, (0.0, 0.1, 0.9), 1.0), (_ARM, (0.0, 0.27, 1.45), -0.8)):
            phase = 0.5 * np.pi * (1.0 + side)
            place = (joint[0], side * joint[1], joint[2])
            swung = (place, swing * amplitude_rad, phase)
            movers.append(_part(Swing(base.radius_m, base.start_rad, base.speed_m_s, 0.0, *swung), limb))
    world = DemoWorld(5, speed=EgoSpeed(speeds_m_s=(1.5,)))
    world.street = replace(world.street, movers=tuple(movers))
    return Walk(world, base, _evidence(world, base, scans))


def rays_towards(walk: Walk, time_s: float) -> tuple[np.ndarray, ...]:
    """Rays fired about the person that return, in its frame: origin, direction, range, whether of it."""
    return _rays(walk.world, walk.body, time_s)


def _rays(world: DemoWorld, base: ArcMotion, time_s: float) -> tuple[np.ndarray, ...]:
    sensor, person = world.lidar_to_street(np.array([time_s]))[0], base.pose(np.array([time_s]))[0]
    towards = transform_points(invert_pose(sensor), person[None, :3, 3])[0]
    ahead_rad = np.arctan2(towards[1], towards[0])
    azimuth, elevation = np.meshgrid(ahead_rad + _AZIMUTHS_RAD, HDL_64E.elevation_rad)
    level = np.cos(elevation.ravel())
    local = np.column_stack(
        [level * np.cos(azimuth.ravel()), level * np.sin(azimuth.ravel()), np.sin(elevation.ravel())]
    )
    origin, direction = np.tile(sensor[:3, 3], (len(local), 1)), local @ sensor[:3, :3].T
    to_world = world.street_to_world
    found = world.cast(
        transform_points(to_world, origin), direction @ to_world[:3, :3].T, np.full(len(local), time_s)
    )
    met = np.isfinite(found.range_m)
    own = invert_pose(person)
    noisy = found.range_m + np.random.default_rng(int(1000 * time_s)).normal(0.0, 0.01, len(met))
    return (
        transform_points(own, origin)[met].astype(np.float32),
        (direction @ own[:3, :3].T)[met].astype(np.float32),
        noisy[met].astype(np.float32), found.instance[met] == PERSON,
    )  # fmt: skip


def _evidence(world: DemoWorld, base: ArcMotion, scans: int) -> ObjectEvidence:
    seen = [_rays(world, base, FRAME_S * scan) for scan in range(scans)]
    origin, direction, range_m, is_hit = (np.concatenate(column) for column in zip(*seen, strict=True))
    scan = np.repeat(np.arange(scans, dtype=np.int32), [len(one[0]) for one in seen])
    instants = FRAME_S * np.arange(scans)
    pose = base.pose(instants)
    yaw = np.unwrap(np.arctan2(pose[:, 1, 0], pose[:, 0, 0]))
    points = origin[is_hit] + direction[is_hit] * range_m[is_hit, None]
    path = MovingObject(
        np.arange(scans, dtype=np.int32), instants, np.column_stack([pose[:, :3, 3], yaw]), FRAME_S,
        points.min(axis=0), points.max(axis=0),
    )  # fmt: skip
    return ObjectEvidence(path, ObjectRays(origin, direction, range_m, np.ones_like(range_m), is_hit, scan))


def _part(motion: ArcMotion, *ellipsoids: tuple[tuple[float, ...], tuple[float, ...]]) -> Mover:
    shapes = ShapeList()
    for centre_m, half_m in ellipsoids:
        shapes.add(Kind.ELLIPSOID, np.array(centre_m), half_m, np.eye(3), int(Material.CLOTH), PERSON)
    return Mover(PERSON, "person", motion, shapes.build(), (1.6, 0.8, 1.8))
