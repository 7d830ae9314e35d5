"""The baseline `reproject`: the evidence ray-cast, and recorded images warped; nothing is learned."""

import numpy as np
import torch

from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.kernels.images.filling import nearest_known
from nvsf_core.recipe.residual import EvidenceSpec
from nvsf_core.recording.drive import Recording, Sweeps
from nvsf_core.recording.images import CameraImages
from nvsf_core.rendering.image_depth import without_sky
from nvsf_core.rendering.rendered import RenderedImage
from nvsf_core.rendering.reproject_camera import nearest_sources, render_by_warping, splat_points
from nvsf_core.rendering.sources import Sources
from nvsf_core.rendering.warping import relative_motion, to_float
from nvsf_core.simulation.ray_renderers import reprojecting_renderer
from nvsf_core.simulation.scene_model import ImageRenderer, SceneModel

_DEPTH_SCANS = 10
"""Training scans nearest to a view in time, whose returns give the warped images their depth."""


def reprojection(recording: Recording) -> SceneModel:
    """The baseline of a scene, the same for every recipe."""
    lidar = None if recording.lidar is None else reprojecting_renderer(recording.lidar)
    camera = warping_renderer(recording) if recording.cameras else None
    return SceneModel(lidar=lidar, camera=camera, prior_scans=EvidenceSpec().votes, copies_unmet=True)


def warping_renderer(recording: Recording) -> ImageRenderer:
    """Renders images: the two nearest training images, warped by the LiDAR's depth and averaged."""

    def warp(
        camera: str, pinhole: Pinhole, pose: np.ndarray, time_s: float, near_s: float | None = None
    ) -> RenderedImage:
        images = recording.cameras[camera].training
        points = depth_points(recording, time_s if near_s is None else near_s)
        found = render_by_warping(pose, pinhole, points, images.rgb, images.pose, source_valid=images.valid)
        is_return = np.isfinite(splat_points(pose, pinhole, points))
        gap_px = nearest_known(is_return)[0] if is_return.any() else np.full(is_return.shape, np.inf)
        return without_sky(found, pose, pinhole, _sources(images, pose), torch.from_numpy(gap_px))

    return warp


def _sources(images: CameraImages, pose: np.ndarray) -> Sources:
    """The images that a view at `pose` (4, 4) is warped from."""
    chosen = nearest_sources(pose, images.pose)
    colours = to_float(images.rgb[chosen])
    shown = torch.from_numpy(images.valid).float().expand(len(chosen), 1, -1, -1)
    motion = torch.stack([relative_motion(pose, images.pose[index]) for index in chosen])
    numbers = list(range(len(chosen)))
    return Sources(torch.cat([colours, shown], dim=1), numbers, motion, torch.ones(len(chosen)))


def depth_points(recording: Recording, instant_s: float, *, leave_out: int | None = None) -> np.ndarray:
    """Returns (m, 3) float32, scene-local, metres, of the scans nearest to an instant; none without LiDAR.

    The scan of the frame `leave_out` is taken to be held out.
    """
    if recording.lidar is None:
        return np.zeros((0, 3), np.float32)
    sweeps = recording.lidar.sweeps
    scans = depth_scans(sweeps, instant_s, leave_out=leave_out)
    return np.concatenate([returns_of_scan(sweeps, scan)[0] for scan in scans]).astype(np.float32)


def depth_scans(sweeps: Sweeps, instant_s: float, *, leave_out: int | None = None) -> list[int]:
    """Numbers of the training scans nearest to an instant, at most 10, the nearest first.

    The scan of the frame `leave_out` is taken to be held out.
    """
    time_s = sweeps.arrays["time_s"]
    training = np.flatnonzero(sweeps.is_training)
    if leave_out is not None and len(training) > 1:
        training = training[sweeps.arrays["frame"][training] != leave_out]
    order = np.argsort(np.abs(time_s[training] - instant_s), kind="stable")
    return [int(scan) for scan in training[order[:_DEPTH_SCANS]]]


def returns_of_scan(sweeps: Sweeps, scan: int) -> tuple[np.ndarray, np.ndarray]:
    """A scan's returns (m, 3), scene-local, metres, without the own vehicle's, and their times (m,) in s."""
    a, part = sweeps.arrays, sweeps.returns_of(scan)
    seen = sweeps.is_of_world(part)
    points = a["origin_m"][part][seen] + a["direction"][part][seen] * a["range_m"][part][seen, None]
    return points, sweeps.fired_s(scan)[seen]
