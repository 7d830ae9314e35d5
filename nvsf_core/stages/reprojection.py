"""The baseline `reproject`: nothing is learned, recorded scans and images are carried into the view."""

import numpy as np

from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.recipe import EvidenceSpec
from nvsf_core.rendering.reproject_camera import render_by_warping
from nvsf_core.simulation.scene_model import SceneModel
from nvsf_core.simulation.sweep_simulation import evidence_renderer
from nvsf_core.stages.evidence import Sweeps
from nvsf_core.stages.recording import Recording

_DEPTH_SCANS = 10
"""Training scans around a view whose returns give the warped images their depth."""


def reprojection(recording: Recording) -> SceneModel:
    """The baseline of a scene, the same for every recipe."""
    spec = EvidenceSpec()
    lidar = None
    if recording.lidar is not None:
        recorded = recording.lidar.sweeps
        lidar = evidence_renderer(
            recording.lidar.evidence,
            recorded.trajectory,
            recorded.table,
            recorded.elevation_correction_rad,
            most=spec.lidar_candidates,
            far_m=recording.lidar.far_m,
        )

    def warp(camera: str, pinhole: Pinhole, pose: np.ndarray, time_s: float) -> np.ndarray:
        images = recording.cameras[camera].training
        valid = np.zeros(pinhole.height * pinhole.width, np.bool_)
        valid[images.pixel] = True
        points = _depth_points(recording, time_s)
        shape = (pinhole.height, pinhole.width)
        rgb, _ = render_by_warping(
            pose, pinhole, points, images.rgb, images.pose, source_valid=valid.reshape(shape)
        )
        return rgb

    return SceneModel(lidar=lidar, camera=warp if recording.cameras else None, votes=spec.votes)


def _depth_points(recording: Recording, instant_s: float) -> np.ndarray:
    """Points (m, 3) float32 scene-local that are known around an instant; none without LiDAR."""
    if recording.lidar is None:
        return np.zeros((0, 3), np.float32)
    return _returns_around(recording.lidar.sweeps, instant_s)


def _returns_around(sweeps: Sweeps, instant_s: float) -> np.ndarray:
    """Returns (m, 3) scene-local of the training scans around an instant, without the own vehicle."""
    a = sweeps.arrays
    training = np.flatnonzero(sweeps.is_training)
    near = training[np.argsort(np.abs(a["time_s"][training] - instant_s), kind="stable")[:_DEPTH_SCANS]]
    parts = []
    for scan in near:
        part = sweeps.returns_of(int(scan))
        seen = ~a["is_own_vehicle"][part]
        parts.append(a["origin_m"][part][seen] + a["direction"][part][seen] * a["range_m"][part][seen, None])
    return np.concatenate(parts).astype(np.float32)
