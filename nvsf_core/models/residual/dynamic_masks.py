"""Moving objects for the cameras: static points without them, and their own points and motion."""

import numpy as np

from nvsf_core.evidence.moving.object_evidence import MovingObject, ObjectEvidence
from nvsf_core.geometry.se3 import transform_points
from nvsf_core.kernels.threads import MOST_VIEWS, in_parts
from nvsf_core.models.baselines.reproject import depth_scans, returns_of_scan
from nvsf_core.recording.drive import Recording, Sweeps
from nvsf_core.recording.images import CameraRecording
from nvsf_core.rendering.lidar_view import MovingPoints, moving_pixels

_MARGIN_M = 0.1
_SHADOW_SCANS = 4
"""Scans of static points with which moving pixels are found; fewer than depth needs."""


class MovingWorld:
    """The static points and moving objects of a drive. The points of a scan are divided once and kept."""

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        self._objects = () if recording.lidar is None else recording.lidar.evidence.objects
        self._static: dict[int, np.ndarray] = {}

    def static_points(
        self, instant_s: float, *, leave_out: int | None = None, most: int | None = None
    ) -> np.ndarray:
        """Static points (m, 3) float32, scene-local, of the scans around an instant; none without LiDAR.

        The scan of the frame `leave_out` is taken to be held out; at most `most` scans, None = as for images.
        """
        if self.recording.lidar is None:
            return np.zeros((0, 3), np.float32)
        sweeps = self.recording.lidar.sweeps
        scans = depth_scans(sweeps, instant_s, leave_out=leave_out)[:most]
        return np.concatenate([self._static_of(sweeps, scan) for scan in scans])

    def own_returns(self, frame: int) -> np.ndarray:
        """Static returns (m, 3) float32, scene-local, of the scan of an image's frame; none without one.

        Only this scan has the image's pose error; other scans have errors of their own.
        """
        assert self.recording.lidar is not None
        sweeps = self.recording.lidar.sweeps
        own = np.flatnonzero((sweeps.arrays["frame"] == frame) & sweeps.is_training)
        return self._static_of(sweeps, int(own[0])) if len(own) else np.zeros((0, 3), np.float32)

    def moving(
        self,
        instant_s: float,
        image_time_s: np.ndarray,
        *,
        leave_out: int | None = None,
        from_m: np.ndarray | None = None,
    ) -> list[MovingPoints]:
        """The moving objects that are present at an instant; none in a static scene.

        Args:
            instant_s: Seconds since the first frame.
            image_time_s: (j,) times of the images that a view is rendered from.
            leave_out: Do as if the scan of the frame of this number were held out.
            from_m: As in `objects_at`; not together with `leave_out`.
        """
        found = []
        own = None if leave_out is None else self._scan_of(leave_out)
        for number, one in enumerate(self._objects, start=1):
            path = one.path.without(own)
            if not path.is_there(np.array([instant_s]))[0]:
                continue
            points = _own_points(one, instant_s, own, from_m)
            if points is None:
                continue
            now = path.matrix_at(np.array([instant_s]))[0]
            moved = path.matrix_at(image_time_s) @ np.linalg.inv(now)
            moved[~path.is_there(image_time_s)] = 0.0
            found.append(MovingPoints(number, transform_points(now, points).astype(np.float32), moved))
        return found

    def shadows(self, camera: CameraRecording) -> np.ndarray | None:
        """Pixels (j, H, W) bool of a camera's images that may show moving objects; None in a static scene."""
        if not self._objects:
            return None
        images, times = camera.training, camera.training_time_s
        nothing = np.zeros(images.rgb.shape[1:3], np.bool_)
        self._divide(times)

        def shadow(number: int) -> np.ndarray:
            points = [one.points_m for one in self.moving(times[number], times)]
            if not points:
                return nothing
            static = self.static_points(times[number], most=_SHADOW_SCANS)
            return moving_pixels(images.pose[number], images.pinhole, static, points)

        return np.stack(in_parts(shadow, len(times), MOST_VIEWS))

    def _scan_of(self, frame: int) -> int | None:
        """Number, among the training scans, of that of a frame; None without one."""
        if self.recording.lidar is None:
            return None
        sweeps = self.recording.lidar.sweeps
        own = np.flatnonzero(sweeps.arrays["frame"][sweeps.is_training] == frame)
        return int(own[0]) if len(own) else None

    def _divide(self, image_time_s: np.ndarray) -> None:
        """Divide the scans around images, each once, before threads ask for them."""
        assert self.recording.lidar is not None  # nothing else finds what moves
        sweeps = self.recording.lidar.sweeps
        near = {one for time_s in image_time_s for one in depth_scans(sweeps, time_s)[:_SHADOW_SCANS]}
        scans = list(near)
        in_parts(lambda number: self._static_of(sweeps, scans[number]), len(scans))

    def _static_of(self, sweeps: Sweeps, scan: int) -> np.ndarray:
        if scan not in self._static:
            points, fired_s = returns_of_scan(sweeps, scan)
            is_static = np.ones(len(points), np.bool_)
            for one in self._objects if len(points) else ():
                is_static &= ~_holds(one.path, points, fired_s)
            self._static[scan] = points[is_static].astype(np.float32)
        return self._static[scan]


def _own_points(
    one: ObjectEvidence, instant_s: float, leave_out: int | None, from_m: np.ndarray | None
) -> np.ndarray | None:
    """Returns (m, 3) of an object in its own frame, from its scans near to an instant; None if none."""
    scans = one.scans_near(instant_s, leave_out=leave_out)
    if from_m is not None:
        scans = one.scans_towards(instant_s, from_m, scans)
    rays = one.rays_at(scans, instant_s)
    return rays.point_m(rays.is_hit) if rays.is_hit.any() else None


def _holds(path: MovingObject, points_m: np.ndarray, fired_s: np.ndarray) -> np.ndarray:
    """(n,) bool: returns, fired at times (n,) s, that lie within a moving object's bounds."""
    held = np.zeros(len(points_m), np.bool_)
    ends_s = np.array([fired_s.min(), fired_s.max()])
    if not path.is_there(ends_s).any():
        return held
    # Only the few returns near its path are transformed to its frame.
    way = path.pose_at(ends_s)[:, :3]
    reach_m = np.linalg.norm(np.maximum(np.abs(path.low_m), np.abs(path.high_m))) + _MARGIN_M
    first_m, last_m = way.min(axis=0) - reach_m, way.max(axis=0) + reach_m
    near = np.flatnonzero((points_m[:, 0] > first_m[0]) & (points_m[:, 0] < last_m[0]))
    near = near[((points_m[near] > first_m) & (points_m[near] < last_m)).all(axis=1)]
    local = path.to_object(points_m[near], fired_s[near])
    inside = (local >= path.low_m - _MARGIN_M) & (local <= path.high_m + _MARGIN_M)
    held[near] = inside.all(axis=1) & path.is_there(fired_s[near])
    return held
