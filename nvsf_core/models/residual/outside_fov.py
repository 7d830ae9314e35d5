"""Surfaces outside the recorded LiDAR's field of view, found by the images, for sensors that look there."""

import numpy as np

from nvsf_core._types import Say
from nvsf_core.evidence.image_surfels import DepthRays, image_surfels
from nvsf_core.geometry.se3 import pose_from_parts
from nvsf_core.models.baselines.reproject import depth_points
from nvsf_core.recipe.residual import EvidenceSpec
from nvsf_core.recording.drive import LidarRecording, Recording
from nvsf_core.rendering.image_depth import image_depth
from nvsf_core.simulation.ray_renderers import image_renderer
from nvsf_core.simulation.scene_model import RayRenderer
from nvsf_core.simulation.sweep_simulation import highest_rad
from nvsf_core.simulation.view_plan import SweepPlan

_MOST_VIEWS = 24
"""Most views of a camera that are used; on longer drives they are evenly spread."""


def looks_above(lidar: LidarRecording, plan: SweepPlan) -> bool:
    """Whether a view's sensor looks above all lasers that recorded the drive, by its lasers or its tilt."""
    highest = highest_rad(lidar.sweeps.table, lidar.evidence)
    own = lidar.evidence.lasers.astype(np.int64) if plan.is_recorded_sensor else slice(None)
    lasers_rad = plan.table.elevation_rad[own]
    return len(lasers_rad) > 0 and float(lasers_rad.max()) + plan.tilt_rad > highest


def seen_above(recording: Recording, say: Say) -> RayRenderer | None:
    """Renders rays by surfaces found in views half-way between training images; None if there are none."""
    lidar = recording.lidar
    if lidar is None:
        return None
    highest = highest_rad(lidar.sweeps.table, lidar.evidence)
    views = []
    for name in recording.cameras:
        halves = _half_way(recording.cameras[name].training_time_s)
        for number, instant_s in enumerate(halves.tolist()):
            views.append(_depths(recording, name, instant_s, highest))
            say(f"outside the field of view, {name} {number + 1}/{len(halves)}")
    shine = lidar.evidence.static.intensity
    surfels = image_surfels(views, far_m=lidar.far_m, intensity=float(shine.mean()))
    if surfels is None:
        return None
    return image_renderer(surfels, most=EvidenceSpec().lidar_candidates, far_m=lidar.far_m)


def _half_way(time_s: np.ndarray) -> np.ndarray:
    """Instants (h,) half-way between images that follow each other; at most 24."""
    ordered = np.sort(time_s)
    halves = 0.5 * (ordered[1:] + ordered[:-1])
    chosen = np.unique(
        np.linspace(0, len(halves) - 1, min(len(halves), _MOST_VIEWS)).round().astype(np.int64)
    )
    return halves[chosen]


def _depths(recording: Recording, camera: str, instant_s: float, highest_rad: float) -> DepthRays:
    """Depths that a camera sees at an instant above an elevation in the LiDAR's frame."""
    rotation, position_m = recording.trajectory.at(np.array([instant_s]))
    pose = pose_from_parts(rotation, position_m)[0] @ recording.cameras[camera].in_lidar
    images = recording.cameras[camera].training
    return image_depth(
        pose, images.pinhole, depth_points(recording, instant_s), images.rgb, images.pose, images.valid,
        up=rotation[0, :, 2], elevation_rad=highest_rad,
    )  # fmt: skip
