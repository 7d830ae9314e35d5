"""Images of a view: rendered by a model, or copied from the nearest training image."""

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.kernels.threads import images_at_once
from nvsf_core.models.baselines.copy_nearest import nearest_earlier
from nvsf_core.recording.drive import Recording
from nvsf_core.rendering.rendered import RenderedImage
from nvsf_core.simulation.other_camera import OtherCamera
from nvsf_core.simulation.scene_model import ImageRenderer
from nvsf_core.simulation.view_plan import ViewPlan
from nvsf_core.stages.runner.stage import Task
from nvsf_core.stages.views.view import View, camera_in_lidar, render_all


def image_arrays(
    task: Task, recording: Recording, view: View, render: ImageRenderer, method: str
) -> dict[str, np.ndarray]:
    """Render every camera at the instants of its plan, those of other intrinsics at all of the view's.

    Args:
        task: Task of the stage, for its progress.
        recording: The drive, with its cameras and trajectory.
        view: Whose images are rendered.
        render: The model's image renderer.
        method: Name of the method, for progress.

    Returns:
        Arrays of the data contract for each camera: images (n, H, W, 3) uint8, lengths of the pixels' rays
        (n, H, W) float16 (exact to 0.05 %) in metres, their support (n, H, W) uint8 where the model knows it,
        frames, poses in the world and seconds.
    """
    arrays: dict[str, np.ndarray] = {}
    for name, plan in (view.images | dict.fromkeys(view.other_cameras, view.plan)).items():
        camera = view.other_cameras.get(name)
        like = name if camera is None else camera.like
        pinhole, in_lidar = recording.cameras[like].training.pinhole, recording.cameras[like].in_lidar
        other = None if camera is None else OtherCamera.of(camera.model(), pinhole)
        in_lidar = in_lidar if camera is None else camera_in_lidar(camera, in_lidar)
        poses = plan.poses(recording.trajectory) @ in_lidar
        shown, seconds = render_all(
            task, partial(_image, like, pinhole, other, poses, plan, render), len(poses),
            f"{plan.name}, {method}, {name}", at_once=images_at_once(pinhole.width * pinhole.height),
        )  # fmt: skip
        arrays |= _arrays_of(name, plan, shown, recording.trajectory.scene_to_world @ poses, seconds)
    return arrays


def _image(
    name: str, pinhole: Pinhole, other: OtherCamera | None, poses: np.ndarray, plan: ViewPlan,
    render: ImageRenderer, number: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:  # fmt: skip
    near_s = None if plan.near_s is None else float(plan.near_s[number])

    def seen(pose: np.ndarray) -> RenderedImage:
        return render(name, pinhole, pose, float(plan.time_s[number]), near_s)

    image = seen(poses[number]) if other is None else other.render(poses[number], seen)
    with np.errstate(over="ignore"):  # lengths beyond 65 km become infinite
        return image.rgb, image.range_m.astype(np.float16), image.support


def _arrays_of(
    name: str, plan: ViewPlan, shown: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray | None]],
    camera_to_world: np.ndarray, seconds: np.ndarray,
) -> dict[str, np.ndarray]:  # fmt: skip
    rgb, range_m, support = zip(*shown, strict=True)
    arrays = _named(name, plan, np.stack(rgb), camera_to_world, seconds)
    arrays[f"{name}_range_m"] = np.stack(range_m)
    if support[0] is not None:
        arrays[f"{name}_support"] = np.stack(support)
    return arrays


def copied_images(recording: Recording, plans: Mapping[str, ViewPlan]) -> dict[str, np.ndarray]:
    """Arrays as of `image_arrays`, with a copy of the training image nearest to each instant's place."""
    arrays, path = dict[str, np.ndarray](), recording.trajectory
    for name, plan in plans.items():
        camera = recording.cameras[name]
        nearest = [nearest_earlier(camera.training_time_s, float(instant)) for instant in plan.near]
        to_world = path.scene_to_world @ (plan.poses(path) @ camera.in_lidar)
        arrays |= _named(name, plan, camera.training.rgb[nearest], to_world, np.zeros(len(nearest)))
    return arrays


def _named(
    name: str, plan: ViewPlan, rgb: np.ndarray, camera_to_world: np.ndarray, seconds: np.ndarray
) -> dict[str, np.ndarray]:
    return {
        f"{name}_rgb": rgb,
        f"{name}_frame": plan.frame,
        f"{name}_time_s": plan.time_s,
        f"{name}_camera_to_world": camera_to_world,
        f"{name}_render_seconds": seconds,
    }
