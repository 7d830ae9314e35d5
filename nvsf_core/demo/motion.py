"""Motion of the demo's vehicles along the street's curve, and the street's pose in the world.

Street frame: the origin is the centre of the road's curve, z is up, the road's surface is z = 0; a place is
(radius, angle). Vehicles drive on the right: counter-clockwise outside the road's middle line, clockwise
inside it.
"""

from dataclasses import dataclass

import numpy as np

from nvsf_core.geometry.se3 import exp_so3, pose_from_parts

ROAD_RADIUS_M = 80.0
"""Radius of the road's middle line."""
FRAME_PERIOD_S = 0.1
"""Time from frame to frame, and of one LiDAR sweep."""
LIDAR_HEIGHT_M = 1.73
"""Mean height of the LiDAR above the road."""
_EGO_RADIUS_M = ROAD_RADIUS_M + 1.05
_EGO_SPEED_M_S = 9.0


@dataclass(frozen=True, slots=True)
class ArcMotion:
    """Motion along a circle about the street's origin with constant acceleration."""

    radius_m: float
    """Radius of the circle."""
    start_rad: float
    """Angle at time 0."""
    speed_m_s: float
    """Speed along the circle at time 0; negative = clockwise. The vehicle faces that way."""
    gain_m_s2: float = 0.0
    """Acceleration; of the other sign than the speed it brakes. The speed must not change its sign."""

    def angle_rad(self, times_s: np.ndarray) -> np.ndarray:
        """Angle on the circle at times (n,)."""
        time = np.asarray(times_s, np.float64)
        return self.start_rad + (self.speed_m_s + 0.5 * self.gain_m_s2 * time) / self.radius_m * time

    def pose(self, times_s: np.ndarray) -> np.ndarray:
        """Poses (n, 4, 4), vehicle to street, at times (n,): x ahead, y left, z up, origin on the road."""
        angle = self.angle_rad(times_s)
        heading = angle + np.where(self.speed_m_s >= 0, 0.5, -0.5) * np.pi
        return upright_pose(self.radius_m, angle, heading, np.zeros_like(angle))


@dataclass(frozen=True, slots=True)
class EgoSpeed:
    """Speed of the recording car: linear between given instants, constant before and after them."""

    times_s: tuple[float, ...] = (0.0,)
    """Ascending, from 0."""
    speeds_m_s: tuple[float, ...] = (_EGO_SPEED_M_S,)
    """Speeds at those instants."""

    def speed_m_s(self, times_s: np.ndarray) -> np.ndarray:
        """Speeds (n,) at times (n,)."""
        return np.interp(times_s, self.times_s, self.speeds_m_s)

    def travelled_m(self, times_s: np.ndarray) -> np.ndarray:
        """Distances (n,) driven from time 0 to times (n,): the integral of the speed."""
        knots, speeds = np.array(self.times_s), np.array(self.speeds_m_s)
        at_knot = np.concatenate([[0.0], np.cumsum(0.5 * np.diff(knots) * (speeds[1:] + speeds[:-1]))])
        before = np.clip(np.searchsorted(knots, times_s, side="right") - 1, 0, None)
        mean_m_s = 0.5 * (speeds[before] + self.speed_m_s(times_s))
        return at_knot[before] + mean_m_s * (times_s - knots[before])


def ego_pose(times_s: np.ndarray, speed: EgoSpeed | None = None) -> np.ndarray:
    """LiDAR-to-street poses (n, 4, 4) of the recording car at times (n,), with some sway.

    The sway is slow (below 1 Hz) and small (3 mrad), so that constant motion between frames is true to 2 mm
    at 20 m, as on a real road. It is proportional to the speed; without `speed` that is 8.7 to 9.3 m/s.
    """
    speed = EgoSpeed() if speed is None else speed
    time = np.asarray(times_s, np.float64)
    sway = speed.speed_m_s(time) / _EGO_SPEED_M_S
    angle = (speed.travelled_m(time) + sway * (0.3 * np.sin(1.0 * time))) / _EGO_RADIUS_M
    heading = angle + 0.5 * np.pi + sway * (0.008 * np.sin(0.9 * time + 0.4))
    height = LIDAR_HEIGHT_M + sway * (0.008 * np.sin(4.0 * time))
    pose = upright_pose(_EGO_RADIUS_M, angle, heading, height)
    roll, pitch = sway * (0.003 * np.sin(3.1 * time + 1.0)), sway * (0.003 * np.sin(4.0 * time + 2.0))
    pose[:, :3, :3] = pose[:, :3, :3] @ exp_so3(np.stack([roll, pitch, np.zeros_like(roll)], axis=-1))
    return pose


def street_to_world() -> np.ndarray:
    """(4, 4): at odd angles, so that nothing is aligned with a voxel grid, and with large coordinates."""
    rotation = exp_so3(np.array([0.0, 0.0, 0.651])) @ exp_so3(np.array([0.013, -0.019, 0.0]))
    start = ego_pose(np.zeros(1))[0, :3, 3]
    return pose_from_parts(rotation, np.array([1000.3, 3700.6, 115.2]) - rotation @ start)


def upright_pose(
    radius_m: float, angle_rad: np.ndarray, heading_rad: np.ndarray, height_m: np.ndarray
) -> np.ndarray:
    """Poses (n, 4, 4) in the street by angle, heading and height (n,): x along the heading, z up."""
    pose = np.zeros((len(angle_rad), 4, 4))
    cosine, sine = np.cos(heading_rad), np.sin(heading_rad)
    pose[:, 0, 0], pose[:, 0, 1] = cosine, -sine
    pose[:, 1, 0], pose[:, 1, 1] = sine, cosine
    pose[:, 2, 2] = pose[:, 3, 3] = 1.0
    pose[:, 0, 3], pose[:, 1, 3] = radius_m * np.cos(angle_rad), radius_m * np.sin(angle_rad)
    pose[:, 2, 3] = height_m
    return pose
