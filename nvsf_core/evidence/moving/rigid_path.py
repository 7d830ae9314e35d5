"""Moving objects and their rigid paths: the pose of each at any time."""

from dataclasses import dataclass, replace

import numpy as np

from nvsf_core.geometry.se3 import pose_from_parts

_BEYOND_FRAMES = 1.5
"""Frames before its first and after its last scan in which an object is still shown, at constant velocity."""


@dataclass(frozen=True, slots=True, eq=False)
class MovingObject:
    """One moving object and its rigid path; in its own frame z is up and x is ahead at first."""

    scan: np.ndarray
    """(k,) int32 ascending: numbers of the training scans that saw it."""
    time_s: np.ndarray
    """(k,) float64 mean times of its returns in them."""
    pose: np.ndarray
    """(k, 4) float64 x, y, z in scene-local metres and yaw in radians, unwrapped, at `time_s`."""
    frame_s: float
    """Seconds from frame to frame."""
    low_m: np.ndarray
    """(3,) metres: lower corner of its returns in its own frame."""
    high_m: np.ndarray
    """(3,) metres: their upper corner."""

    def pose_at(self, time_s: np.ndarray) -> np.ndarray:
        """Poses (r, 4) of x, y, z, yaw at times (r,): linear between scans, constant velocity beyond."""
        time_s = np.asarray(time_s, np.float64)
        if len(self.time_s) == 1:
            return np.repeat(self.pose, len(time_s), axis=0)
        before = np.clip(np.searchsorted(self.time_s, time_s) - 1, 0, len(self.time_s) - 2)
        start_s = self.time_s[before]
        share = (time_s - start_s) / (self.time_s[before + 1] - start_s)
        pose: np.ndarray = self.pose[before] + share[:, None] * (self.pose[before + 1] - self.pose[before])
        return pose

    def without(self, scan: int | None) -> "MovingObject":
        """The path without one of its scans; itself where that scan did not see the object."""
        kept = self.scan != scan
        if kept.all():
            return self
        return replace(self, scan=self.scan[kept], time_s=self.time_s[kept], pose=self.pose[kept])

    @property
    def there_s(self) -> tuple[float, float]:
        """First and last instant, 1.5 frames beyond the path's scans; an empty interval without scans."""
        if len(self.time_s) == 0:
            return np.inf, -np.inf
        spare_s = _BEYOND_FRAMES * self.frame_s
        return float(self.time_s[0] - spare_s), float(self.time_s[-1] + spare_s)

    def is_there(self, time_s: np.ndarray) -> np.ndarray:
        """Whether (r,) bool times (r,) lie within `there_s`."""
        first_s, last_s = self.there_s
        return np.asarray((time_s >= first_s) & (time_s <= last_s))

    def matrix_at(self, time_s: np.ndarray) -> np.ndarray:
        """Object-to-scene poses (r, 4, 4) at times (r,)."""
        pose = self.pose_at(time_s)
        return pose_from_parts(_about_z(pose[:, 3]), pose[:, :3])

    def to_object(self, point_m: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        """Scene-local points (r, 3), each at its own time (r,), moved to the object's frame, float64."""
        pose = self.pose_at(time_s)
        return self.turn_to_object(point_m - pose[:, :3], pose[:, 3])

    @staticmethod
    def turn_to_object(vector: np.ndarray, yaw_rad: np.ndarray) -> np.ndarray:
        """Scene-local vectors (r, 3) in the axes of an object with the yaws `yaw_rad` (r,)."""
        cosine, sine = np.cos(yaw_rad), np.sin(yaw_rad)
        x, y, z = vector[:, 0], vector[:, 1], vector[:, 2]
        return np.stack([cosine * x + sine * y, cosine * y - sine * x, z], axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class MovingObjects:
    """All moving objects of a drive; object i of `objects` has the id i."""

    objects: tuple[MovingObject, ...]
    """Largest first."""
    object_id: np.ndarray
    """(N,) int32 of every training return; -1 = not on a moving object."""
    density: float = 1.0
    """From `laser_density`."""

    @property
    def is_static(self) -> bool:
        """Nothing moves."""
        return len(self.objects) == 0


def _about_z(yaw_rad: np.ndarray) -> np.ndarray:
    cosine, sine = np.cos(yaw_rad), np.sin(yaw_rad)
    zero, one = np.zeros_like(cosine), np.ones_like(cosine)
    rows = ([cosine, -sine, zero], [sine, cosine, zero], [zero, zero, one])
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
