"""Prepares the paper's training data from a recording, and loads its trained model."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from nvsf_core.errors import DataError
from nvsf_core.fields.raydrop_unet import RaydropUnet
from nvsf_core.fields.scene_field import SceneField
from nvsf_core.geometry.bounds import OUTERMOST_SHARE, Bounds
from nvsf_core.geometry.se3 import pose_from_parts
from nvsf_core.models.family import Weights, training_device
from nvsf_core.models.paper.flow_training import flow_cloud
from nvsf_core.models.paper.render import PaperModel
from nvsf_core.models.paper.training_frames import Images, Panos, PaperFrames
from nvsf_core.recipe.paper import PaperRecipe
from nvsf_core.recording.drive import LidarRecording, Recording
from nvsf_core.simulation.scene_model import SceneModel

CAMERA_REACH_M = 60.0
"""Half an edge of the cube around the cameras' path, for drives without LiDAR."""
_BOX_POINTS_STEP = 7
"""Every seventh return is enough for the quantiles that decide the box."""


def needed(recipe: PaperRecipe, recording: Recording) -> PaperRecipe:
    """The recipe without the encoder and losses of a sensor that the drive does not have."""
    if recording.lidar is not None and recording.cameras:
        return recipe
    sampling = replace(recipe.sampling, camera=recipe.sampling.camera and bool(recording.cameras))
    return replace(recipe, sampling=sampling, encoders="same")


def frame_count(recording: Recording) -> int:
    """N of the paper: number of frames from the first to the last, held-out ones and gaps included."""
    return int(recording.posed_frame[-1] - recording.posed_frame[0]) + 1


def frame_at(recording: Recording) -> Callable[[float], float]:
    """A function from seconds since the first frame to frame coordinates 0..n-1, clamped at both ends."""
    known_s, frame = recording.posed_time_s, recording.posed_frame - recording.posed_frame[0]
    return lambda time_s: float(np.interp(time_s, known_s, frame))


def scene_bounds(recipe: PaperRecipe, recording: Recording) -> Bounds:
    """The cube around the training scans' returns, or without LiDAR around the cameras' path."""
    share = 0.0 if recipe.slips.minmax_box else OUTERMOST_SHARE
    if recording.lidar is not None:
        scans = _training_scans(recording.lidar)
        points_m = np.concatenate([_points(recording.lidar, int(scan)) for scan in scans])
        return Bounds.of_points(points_m[::_BOX_POINTS_STEP], outermost_share=share, bound=recipe.slips.bound)
    path = np.concatenate([camera.training.pose[:, :3, 3] for camera in recording.cameras.values()])
    corners = np.concatenate([path - CAMERA_REACH_M, path + CAMERA_REACH_M])
    return Bounds.of_points(corners, outermost_share=0.0, bound=recipe.slips.bound)


def training_frames(recipe: PaperRecipe, recording: Recording) -> PaperFrames:
    """Panos, flow clouds and images of the training frames.

    Raises:
        DataError: The scans were not projected to panos.
    """
    bounds = scene_bounds(recipe, recording)
    number = frame_at(recording)
    cameras = tuple(
        Images(
            name=name,
            images=camera.training,
            frame=(camera.training_frame - recording.posed_frame[0]).astype(np.float64),
            moment=np.array([number(float(time_s)) for time_s in camera.training_time_s]),
        )
        for name, camera in recording.cameras.items()
        if recipe.sampling.camera
    )
    panos = None if recording.lidar is None else _panos(recipe, recording, bounds)
    return PaperFrames(bounds=bounds, count=frame_count(recording), panos=panos, cameras=cameras)


def _panos(recipe: PaperRecipe, recording: Recording, bounds: Bounds) -> Panos:
    lidar = recording.lidar
    assert lidar is not None
    if lidar.read_panos is None:
        raise DataError("expected the scans projected to linear panos, found none; run the stage `pano`")
    recorded = lidar.read_panos()
    scans = _training_scans(lidar)
    frame = lidar.sweeps.arrays["frame"][scans]
    row = np.searchsorted(recorded.frame, frame)
    pose = pose_from_parts(*lidar.sweeps.trajectory.at(lidar.sweeps.arrays["time_s"][scans]))
    # The clouds are data: the same for every seed of training.
    generator = np.random.default_rng(0)
    clouds = [
        flow_cloud(_points(lidar, int(scan)), pose[k], np.array(bounds.centre_m), generator) / bounds.half_m
        if recipe.aggregate
        else np.zeros((0, 3), np.float32)
        for k, scan in enumerate(scans)
    ]
    return Panos(
        frame=(frame - recording.posed_frame[0]).astype(np.float64),
        pose=pose,
        range_m=torch.from_numpy(recorded.range_m[row]),
        intensity=torch.from_numpy(recorded.intensity[row]),
        clouds=tuple(cloud.astype(np.float32) for cloud in clouds),
        turn_up_rad=_turn_up_rad(recipe, lidar),
    )


def _turn_up_rad(recipe: PaperRecipe, lidar: LidarRecording) -> float:
    """Angle by which panos' rays are turned up: that of the sensor's sweeps."""
    return 0.0 if recipe.slips.recorded_elevations else lidar.sweeps.elevation_correction_rad


def _training_scans(lidar: LidarRecording) -> np.ndarray:
    return np.flatnonzero(lidar.sweeps.is_training)


def _points(lidar: LidarRecording, scan: int) -> np.ndarray:
    """Returns (m, 3) float64 of a scan, scene-local, metres, each at its own time if that is known."""
    part, a = lidar.sweeps.returns_of(scan), lidar.sweeps.arrays
    kept = a["range_m"][part] < lidar.far_m
    origin, direction = a["origin_m"][part][kept], a["direction"][part][kept]
    range_m = a["range_m"][part][kept].astype(np.float64)
    return origin.astype(np.float64) + direction * range_m[:, None]


def load(
    recipe: PaperRecipe, weights: Weights, recording: Recording, *, with_camera: bool = True
) -> SceneModel:
    """See `Family.load`."""
    recipe, facts = needed(recipe, recording), weights.facts
    bounds = Bounds(centre_m=tuple(facts["centre_m"]), half_m=facts["half_m"], bound=facts["bound"])
    field = SceneField(recipe, frame_count(recording), torch.Generator())
    weights.load_into(field, "field.")
    unet = None
    if weights.has("unet."):
        unet = RaydropUnet(recipe.refinement.channels, torch.Generator())
        weights.load_into(unet, "unet.")
        unet = unet.to(training_device()).eval()
    model = PaperModel(
        recipe=recipe,
        field=field.to(training_device()),
        bounds=bounds,
        frame_at=frame_at(recording),
        unet=unet,
        turn_up_rad=0.0 if recording.lidar is None else _turn_up_rad(recipe, recording.lidar),
    )
    has_lidar, has_camera = recording.lidar is not None, recipe.sampling.camera and bool(recording.cameras)
    return SceneModel(
        lidar=model.render_rays if has_lidar else None,
        camera=model.render_image if has_camera and with_camera else None,
        pano=model.render_pano if has_lidar else None,
        as_recorded=True,
    )
