"""How the demo street lies in the world, and how its vehicles move along its curve.

Street frame: the centre of the road's curve is its origin, z up, the road's surface is z = 0; a place
is (radius, angle). Everything drives counter-clockwise on the outer side (radius > road's) and clockwise
on the inner side, as right-hand traffic does.
"""

from dataclasses import dataclass

import numpy as np

from nvsf_core.geometry.se3 import exp_so3, pose_from_parts

__all__ = [
    "FRAME_PERIOD_S",
    "LIDAR_HEIGHT_M",
    "ROAD_RADIUS_M",
    "ArcMotion",
    "EgoSpeed",
    "ego_pose",
    "street_to_world",
]

ROAD_RADIUS_M = 80.0
"""Of the road's middle line."""
FRAME_PERIOD_S = 0.1
"""From frame to frame; one LiDAR turn takes as long."""
LIDAR_HEIGHT_M = 1.73
"""Of the LiDAR above the road, on average."""
_EGO_RADIUS_M = ROAD_RADIUS_M + 1.05
_EGO_SPEED_M_S = 9.0


@dataclass(frozen=True, slots=True)
class ArcMotion:
    """Motion along a circle about the street's origin, getting faster or slower evenly."""

    radius_m: float
    """Of the circle."""
    start_rad: float
    """Angle at time 0."""
    speed_m_s: float
    """Along the circle at time 0; negative is clockwise. Heading follows it."""
    gain_m_s2: float = 0.0
    """How fast the speed grows; of the other sign than the speed it brakes, and must not turn it round."""

    def angle_rad(self, times_s: np.ndarray) -> np.ndarray:
        """Angle on the circle at times (n,)."""
        time = np.asarray(times_s, np.float64)
        return self.start_rad + (self.speed_m_s + 0.5 * self.gain_m_s2 * time) / self.radius_m * time

    def pose(self, times_s: np.ndarray) -> np.ndarray:
        """Poses (n, 4, 4) in the street: x ahead, y left, z up, origin on the road."""
        angle = self.angle_rad(times_s)
        heading = angle + np.where(self.speed_m_s >= 0, 0.5, -0.5) * np.pi
        return _upright_pose(self.radius_m, angle, heading, np.zeros_like(angle))


@dataclass(frozen=True, slots=True)
class EgoSpeed:
    """How fast the recording car goes: linear between instants, even before the first and after the last."""

    times_s: tuple[float, ...] = (0.0,)
    """Ascending, from 0."""
    speeds_m_s: tuple[float, ...] = (_EGO_SPEED_M_S,)
    """At those instants; 0 stands still."""

    def speed_m_s(self, times_s: np.ndarray) -> np.ndarray:
        """Speeds (n,) at times (n,)."""
        return np.interp(times_s, self.times_s, self.speeds_m_s)

    def travelled_m(self, times_s: np.ndarray) -> np.ndarray:
        """Way (n,) since time 0: the integral of the speed."""
        knots, speeds = np.array(self.times_s), np.array(self.speeds_m_s)
        at_knot = np.concatenate([[0.0], np.cumsum(0.5 * np.diff(knots) * (speeds[1:] + speeds[:-1]))])
        before = np.clip(np.searchsorted(knots, times_s, side="right") - 1, 0, None)
        mean_m_s = 0.5 * (speeds[before] + self.speed_m_s(times_s))
        way_m: np.ndarray = at_knot[before] + mean_m_s * (times_s - knots[before])
        return way_m


def ego_pose(times_s: np.ndarray, speed: EgoSpeed | None = None) -> np.ndarray:
    """LiDAR-to-street poses (n, 4, 4) of the recording car at times (n,): 8.7 to 9.3 m/s, swaying a little.

    The sway is slow (below 1 Hz) and small (3 mrad), so that constant motion between frames is
    true to 2 mm at 20 m, as on a real road. With a `speed` of its own it sways as much less as it is slower.
    """
    speed = EgoSpeed() if speed is None else speed
    time = np.asarray(times_s, np.float64)
    sway = speed.speed_m_s(time) / _EGO_SPEED_M_S
    angle = (speed.travelled_m(time) + sway * (0.3 * np.sin(1.0 * time))) / _EGO_RADIUS_M
    heading = angle + 0.5 * np.pi + sway * (0.008 * np.sin(0.9 * time + 0.4))
    height = LIDAR_HEIGHT_M + sway * (0.008 * np.sin(4.0 * time))
    pose = _upright_pose(_EGO_RADIUS_M, angle, heading, height)
    roll, pitch = sway * (0.003 * np.sin(3.1 * time + 1.0)), sway * (0.003 * np.sin(4.0 * time + 2.0))
    pose[:, :3, :3] = pose[:, :3, :3] @ exp_so3(np.stack([roll, pitch, np.zeros_like(roll)], axis=-1))
    return pose


def street_to_world() -> np.ndarray:
    """(4, 4): odd angles, so that nothing is aligned with a voxel grid, and far away as KITTI-360 is."""
    rotation = exp_so3(np.array([0.0, 0.0, 0.651])) @ exp_so3(np.array([0.013, -0.019, 0.0]))
    start = ego_pose(np.zeros(1))[0, :3, 3]
    return pose_from_parts(rotation, np.array([1000.3, 3700.6, 115.2]) - rotation @ start)


def _upright_pose(
    radius_m: float, angle_rad: np.ndarray, heading_rad: np.ndarray, height_m: np.ndarray
) -> np.ndarray:
    pose = np.zeros((len(angle_rad), 4, 4))
    cosine, sine = np.cos(heading_rad), np.sin(heading_rad)
    pose[:, 0, 0], pose[:, 0, 1] = cosine, -sine
    pose[:, 1, 0], pose[:, 1, 1] = sine, cosine
    pose[:, 2, 2] = pose[:, 3, 3] = 1.0
    pose[:, 0, 3], pose[:, 1, 3] = radius_m * np.cos(angle_rad), radius_m * np.sin(angle_rad)
    pose[:, 2, 3] = height_m
    return pose
