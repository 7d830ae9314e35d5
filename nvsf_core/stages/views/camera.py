"""Images of a view: rendered by a model, or copied from the nearest training image."""

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

from nvsf_core.drives.view_parts import CameraEntry
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.kernels.threads import images_at_once
from nvsf_core.models.baselines.copy_nearest import nearest_earlier
from nvsf_core.recording.drive import Recording
from nvsf_core.rendering.rendered import RenderedImage
from nvsf_core.simulation.other_camera import OtherCamera
from nvsf_core.simulation.scene_model import ImageRenderer
from nvsf_core.simulation.view_plan import ViewPlan
from nvsf_core.stages.runner.stage import Task
from nvsf_core.stages.views.view import View, camera_in_lidar, reference_poses, render_all, to_world


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
        (n, H, W) float16 (exact to 0.05 %) in metres, their support (n, H, W) uint8 where the model knows it,
        frames, poses in the world and seconds.
    """
    arrays: dict[str, np.ndarray] = {}
    for name, plan in plans.items():
        pinhole = recording.cameras[name].training.pinhole
        poses = _camera_poses(recording, name, plan)
        one = partial(_image, name, pinhole, poses, plan, render)
        shown, seconds = render_all(
            task, one, len(poses), f"{plan.name}, {method}, {name}",
            at_once=images_at_once(pinhole.width * pinhole.height),
        )  # fmt: skip
        arrays |= _arrays_of(name, plan, shown, to_world(recording, poses), seconds)
    return arrays


def other_image_arrays(
    task: Task, recording: Recording, view: View, render: ImageRenderer, method: str
) -> dict[str, np.ndarray]:
    """Render the cameras of other intrinsics at all instants of a view; arrays as of `image_arrays`.

    Args:
        task: Task of the stage, for its progress.
        recording: The drive, with its cameras and trajectory.
        view: With its `other_cameras`.
        render: The model's image renderer.
        method: Name of the method, for progress.
    """
    arrays: dict[str, np.ndarray] = {}
    for name, camera in view.other_cameras.items():
        pinhole = recording.cameras[camera.like].training.pinhole
        other = OtherCamera.of(camera.model(), pinhole)
        poses = reference_poses(recording, view.plan) @ camera_in_lidar(
            camera, recording.cameras[camera.like].in_lidar
        )

        def image(
            number: int, camera: CameraEntry = camera, other: OtherCamera = other, poses: np.ndarray = poses
        ) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
            def one(pose: np.ndarray) -> RenderedImage:
                return _rendered(camera.like, other.pinhole, pose, view.plan, render, number)

            return _stored(other.render(poses[number], one))

        shown, seconds = render_all(
            task, image, len(poses), f"{view.name}, {method}, {name}",
            at_once=images_at_once(other.pinhole.width * other.pinhole.height),
        )  # fmt: skip
        arrays |= _arrays_of(name, view.plan, shown, to_world(recording, poses), seconds)
    return arrays


def _image(
    name: str, pinhole: Pinhole, poses: np.ndarray, plan: ViewPlan, render: ImageRenderer, number: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    return _stored(_rendered(name, pinhole, poses[number], plan, render, number))


def _rendered(
    name: str, pinhole: Pinhole, pose: np.ndarray, plan: ViewPlan, render: ImageRenderer, number: int
) -> RenderedImage:
    near_s = None if plan.near_s is None else float(plan.near_s[number])
    return render(name, pinhole, pose, float(plan.time_s[number]), near_s)


def _stored(image: RenderedImage) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
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
    arrays: dict[str, np.ndarray] = {}
    for name, plan in plans.items():
        camera = recording.cameras[name]
        nearest = [nearest_earlier(camera.training_time_s, float(instant)) for instant in plan.near]
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
        f"{name}_time_s": plan.time_s,
        f"{name}_camera_to_world": camera_to_world,
        f"{name}_render_seconds": seconds,
    }
