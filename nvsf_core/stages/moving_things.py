"""What moves, as the cameras need it: depth without it, its points at an instant, its way to each image."""

import numpy as np

from nvsf_core.evidence.moving import MovingObject
from nvsf_core.evidence.objects import ObjectEvidence
from nvsf_core.geometry.se3 import transform_points
from nvsf_core.rendering.camera_view import MovingThing, moving_pixels
from nvsf_core.stages.evidence import Sweeps
from nvsf_core.stages.recording import CameraRecording, Recording
from nvsf_core.stages.reprojection import depth_scans, returns_of_scan

_MARGIN_M = 0.1


def still_points(recording: Recording, instant_s: float, *, leave_out: bool = False) -> np.ndarray:
    """Points (m, 3) float32 scene-local of what stands still around an instant; none without LiDAR.

    Args:
        recording: The drive.
        instant_s: Seconds since the first frame.
        leave_out: Do as if the scan of that instant were held out.
    """
    if recording.lidar is None:
        return np.zeros((0, 3), np.float32)
    sweeps = recording.lidar.sweeps
    parts = []
    for scan in depth_scans(sweeps, instant_s, leave_out=leave_out):
        points, fired_s = returns_of_scan(sweeps, scan)
        still = np.ones(len(points), np.bool_)
        for one in _objects(recording):
            still &= ~_holds(one.path, points, fired_s)
        parts.append(points[still])
    return np.concatenate(parts).astype(np.float32)


def moving_things(
    recording: Recording, instant_s: float, image_time_s: np.ndarray, *, leave_out: bool = False
) -> list[MovingThing]:
    """The objects that move and may be seen at an instant; none in a static scene.

    Args:
        recording: The drive.
        instant_s: Seconds since the first frame.
        image_time_s: (j,) of the images that a view is made of.
        leave_out: Do as if the scan of that instant were held out.
    """
    things = []
    for one in _objects(recording):
        path = one.path
        if not path.is_there(np.array([instant_s]))[0]:
            continue
        points = _own_points(one, recording.lidar.sweeps, instant_s, leave_out) if recording.lidar else None
        if points is None:
            continue
        now = path.matrix_at(np.array([instant_s]))[0]
        moved = path.matrix_at(image_time_s) @ np.linalg.inv(now)
        moved[~path.is_there(image_time_s)] = 0.0
        things.append(MovingThing(transform_points(now, points).astype(np.float32), moved))
    return things


def shadows(recording: Recording, camera: CameraRecording) -> np.ndarray | None:
    """Pixels (j, H, W) bool of a camera's training images that may show what moves; None if nothing does."""
    if not _objects(recording):
        return None
    images, times = camera.training, camera.training_time_s
    found = np.zeros(images.rgb.shape[:3], np.bool_)
    for number, instant_s in enumerate(times.tolist()):
        things = moving_things(recording, instant_s, times)
        if things:
            still = still_points(recording, instant_s)
            found[number] = moving_pixels(
                images.pose[number], images.pinhole, still, [thing.points_m for thing in things]
            )
    return found


def _objects(recording: Recording) -> tuple[ObjectEvidence, ...]:
    dynamic = None if recording.lidar is None else recording.lidar.evidence.dynamic
    return () if dynamic is None else dynamic.objects


def _own_points(one: ObjectEvidence, sweeps: Sweeps, instant_s: float, leave_out: bool) -> np.ndarray | None:
    """Returns (m, 3) of an object's nearest scans in its own frame; None where they saw nothing of it."""
    own = None
    if leave_out:
        training_s = sweeps.arrays["time_s"][sweeps.is_training]
        own = int(np.argmin(np.abs(training_s - instant_s)))
    rays = one.rays
    used = np.isin(rays.scan, one.scans_near(instant_s, leave_out=own)) & rays.is_hit
    if not used.any():
        return None
    points: np.ndarray = rays.origin_m[used] + rays.direction[used] * rays.range_m[used, None]
    return points


def _holds(path: MovingObject, points_m: np.ndarray, fired_s: np.ndarray) -> np.ndarray:
    """(n,) bool: returns within an object's bounds when they were fired."""
    if not path.is_there(fired_s).any():
        return np.zeros(len(points_m), np.bool_)
    local = path.to_object(points_m, fired_s)
    inside = (local >= path.low_m - _MARGIN_M) & (local <= path.high_m + _MARGIN_M)
    return np.asarray(inside.all(axis=1) & path.is_there(fired_s))
