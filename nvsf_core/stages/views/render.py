"""Render a view by a model, and the attributes that are stored with it."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from nvsf_core._types import Scalar
from nvsf_core.evidence.range_noise import measured_range_noise_m
from nvsf_core.geometry.fisheye import MeiFisheye
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.models.residual.outside_fov import looks_above, seen_above
from nvsf_core.recording.drive import Recording
from nvsf_core.simulation.scene_model import SceneModel
from nvsf_core.stages.runner.stage import Task
from nvsf_core.stages.views.camera import camera_in_lidar, image_arrays, other_image_arrays
from nvsf_core.stages.views.lidar import own_panos, sweep_arrays
from nvsf_core.stages.views.plan import View, reference_poses, to_world
from nvsf_core.stages.views.stored_plan import plan_arrays, plan_attrs

MESH = "mesh"


def render_view_arrays(
    task: Task, recording: Recording, view: View, model: SceneModel, method: str
) -> dict[str, np.ndarray]:
    """Arrays that a model renders of a view, for the sensors that drive, view and model all have.

    Args:
        task: Task of the stage, for its progress.
        recording: The drive.
        view: What to render.
        model: What renders it.
        method: Its name, for progress.
    """
    arrays: dict[str, np.ndarray] = {}
    if recording.lidar is not None and view.sweeps is not None and model.lidar is not None:
        arrays |= sweep_arrays(task, recording.lidar, view.sweeps, model, method)
        if model.pano is not None and view.sweeps.is_recorded_sensor and view.plan.is_as_recorded:
            arrays |= own_panos(task, reference_poses(recording, view.plan), view.sweeps, model.pano)
    if model.camera is not None:
        arrays |= image_arrays(task, recording, view.images, model.camera, method)
        arrays |= other_image_arrays(task, recording, view, model.camera, method)
    return arrays


def placed(recording: Recording, view: View) -> dict[str, np.ndarray]:
    """Arrays of the data contract on a view's instants and poses."""
    poses = to_world(recording, reference_poses(recording, view.plan))
    return plan_arrays(view.plan) | {"lidar_to_world": poses}


def view_attrs(recording: Recording, view: View, *, by_images: bool = False) -> dict[str, Any]:
    """Attributes of the data contract on a view's plan and sensors.

    Args:
        recording: The drive.
        view: The view.
        by_images: Whether images supplied the rays above the recorded lasers.
    """
    table = None if view.sweeps is None else view.sweeps.table
    return plan_attrs(view.plan) | {
        "sensor": "" if table is None else table.name,
        "sensor_max_range_m": None if table is None else table.max_range_m,
        **_sweep_facts(recording, view),
        "cameras_like": {name: one.like for name, one in view.other_cameras.items()},
        **_camera_facts(recording, view),
        "above_lasers_by_images": by_images,
    }


def _sweep_facts(recording: Recording, view: View) -> dict[str, Any]:
    """What a data set needs of a view's sweeps: their duration, the lasers of the grid's rows, the noise."""
    if recording.lidar is None or view.sweeps is None:
        return {}
    sweeps, table = recording.lidar.sweeps, view.sweeps.table
    own = view.sweeps.is_recorded_sensor
    lasers = recording.lidar.evidence.lasers if own else np.arange(table.laser_count)
    a = sweeps.arrays
    noise_m = measured_range_noise_m(a["range_m"], a["laser"], a["firing"], a["offsets"])
    return {
        "sweep_period_s": view.sweeps.sweep_s(sweeps.period_s),
        "grid_lasers": np.asarray(lasers).astype(int).tolist(),
        "measured_range_noise_m": noise_m if np.isfinite(noise_m) else None,
    }


def _camera_facts(recording: Recording, view: View) -> dict[str, Any]:
    """Models and mountings of a view's cameras; the images of recorded ones are undistorted."""
    models: dict[str, Pinhole | MeiFisheye] = {
        name: recording.cameras[name].training.pinhole for name in view.images
    }
    in_lidar = {name: recording.cameras[name].in_lidar for name in view.images}
    for name, camera in view.other_cameras.items():
        models[name] = camera.model()
        in_lidar[name] = camera_in_lidar(camera, recording.cameras[camera.like].in_lidar)
    return {
        "camera_models": {
            name: {"kind": "pinhole" if isinstance(model, Pinhole) else "mei", **asdict(model)}
            for name, model in models.items()
        },
        "camera_in_lidar": {name: pose.reshape(-1).tolist() for name, pose in in_lidar.items()},
    }


def with_images(
    task: Task, recording: Recording, models: Mapping[str, SceneModel], asked: Sequence[View | None]
) -> tuple[dict[str, SceneModel], dict[str, Scalar]]:
    """The models, all but the mesh with surfaces above the recorded lasers, found by images; and metadata.

    Args:
        task: Task of the stage, for its progress.
        recording: The drive.
        models: By name.
        asked: All views that are rendered.
    """
    lidar = recording.lidar
    plans = [view.sweeps for view in asked if view is not None and view.sweeps is not None]
    if lidar is None or not any(looks_above(lidar, plan) for plan in plans):
        return dict(models), {}
    started = time.perf_counter()
    above = seen_above(recording, lambda line: task.progress(f"[{task.scene.name}] novel_views: {line}"))
    said: dict[str, Scalar] = {
        "above_lasers": "unknown: no images show it" if above is None else "rendered from images",
        "above_lasers_seconds": time.perf_counter() - started,
    }
    return {
        name: model if name == MESH else replace(model, above=above) for name, model in models.items()
    }, said


def asks_images(recording: Recording, view: View, model: SceneModel) -> bool:
    """Whether images supply a part of a view's sweeps."""
    if recording.lidar is None or view.sweeps is None or model.above is None:
        return False
    return looks_above(recording.lidar, view.sweeps)
