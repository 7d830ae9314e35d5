"""Images of a view: rendered by a model, or copied from the nearest training image."""

import time
from collections.abc import Mapping

import numpy as np

from nvsf_core.models.baselines.copy_nearest import nearest_earlier
from nvsf_core.recording.drive import Recording
from nvsf_core.simulation.scene_model import ImageRenderer
from nvsf_core.simulation.view_plan import ViewPlan
from nvsf_core.stages.runner.stage import Task
from nvsf_core.stages.views.plan import reference_poses, to_world


def image_arrays(
    task: Task, recording: Recording, plans: Mapping[str, ViewPlan], render: ImageRenderer, method: str
) -> dict[str, np.ndarray]:
    """Render every camera at the instants of its plan.

    Args:
        task: Task of the stage, for its progress.
        recording: The drive, with its cameras and trajectory.
        plans: Camera to the instants of its images.
        render: The model's image renderer.
        method: Name of the method, for progress.

    Returns:
        Arrays of the data contract for each camera: images (n, H, W, 3) uint8, lengths of the pixels' rays
        (n, H, W) float16 (exact to 0.05 %) in metres, frames, poses in the world and seconds.
    """
    arrays: dict[str, np.ndarray] = {}
    for name, plan in plans.items():
        pinhole = recording.cameras[name].training.pinhole
        poses = _camera_poses(recording, name, plan)
        shown, range_m, seconds = [], [], []
        for number, instant in enumerate(plan.time_s):
            started = time.perf_counter()
            image = render(name, pinhole, poses[number], float(instant))
            seconds.append(time.perf_counter() - started)
            shown.append(image.rgb)
            with np.errstate(over="ignore"):  # lengths beyond 65 km become infinite
                range_m.append(image.range_m.astype(np.float16))
            task.progress(
                f"[{task.scene.name}] novel_views: {plan.name}, {method}, {name} "
                f"{number + 1}/{len(plan.time_s)}, {seconds[-1]:.2f} s"
            )
        arrays |= _named(name, plan, np.stack(shown), to_world(recording, poses), np.array(seconds))
        arrays[f"{name}_range_m"] = np.stack(range_m)
    return arrays


def copied_images(recording: Recording, plans: Mapping[str, ViewPlan]) -> dict[str, np.ndarray]:
    """Arrays as of `image_arrays`, with a copy of the nearest training image of each instant."""
    arrays: dict[str, np.ndarray] = {}
    for name, plan in plans.items():
        camera = recording.cameras[name]
        nearest = [nearest_earlier(camera.training_time_s, float(instant)) for instant in plan.time_s]
        poses = to_world(recording, _camera_poses(recording, name, plan))
        arrays |= _named(name, plan, camera.training.rgb[nearest], poses, np.zeros(len(nearest)))
    return arrays


def _camera_poses(recording: Recording, camera: str, plan: ViewPlan) -> np.ndarray:
    """(n, 4, 4) scene-local poses of a camera, by its fixed place relative to the LiDAR."""
    poses: np.ndarray = reference_poses(recording, plan) @ recording.cameras[camera].in_lidar
    return poses


def _named(
    name: str, plan: ViewPlan, rgb: np.ndarray, camera_to_world: np.ndarray, seconds: np.ndarray
) -> dict[str, np.ndarray]:
    return {
        f"{name}_rgb": rgb,
        f"{name}_frame": plan.frame,
        f"{name}_camera_to_world": camera_to_world,
        f"{name}_render_seconds": seconds,
    }
