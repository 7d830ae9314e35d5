"""Stage `novel_views`: render the held-out frames and every view of the catalogue."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from nvsf_core._types import Scalar
from nvsf_core.clouds.open3d_room import NO_OPEN3D
from nvsf_core.demo.drive import DEMO_SEQUENCE
from nvsf_core.drives.entries import ViewEntry
from nvsf_core.drives.view_parts import tilted_words
from nvsf_core.errors import MissingLibraryError
from nvsf_core.models.baselines.mesh import mesh_baseline
from nvsf_core.models.baselines.reproject import reprojection
from nvsf_core.models.residual.outside_fov import looks_above, seen_above
from nvsf_core.recording.drive import Recording
from nvsf_core.simulation.scene_model import SceneModel
from nvsf_core.stages.checks.images import check_images
from nvsf_core.stages.checks.own_vehicle import check_ghosts
from nvsf_core.stages.checks.support import check_support
from nvsf_core.stages.checks.views import check_views
from nvsf_core.stages.field import load_model
from nvsf_core.stages.inputs import read_recording
from nvsf_core.stages.mesh import read_mesh
from nvsf_core.stages.runner.record import read_record
from nvsf_core.stages.runner.stage import Check, StageOutput, Task
from nvsf_core.stages.views.camera import copied_images, image_arrays
from nvsf_core.stages.views.files import (
    describe_view,
    scans_of,
    write_images,
    write_method,
    write_scans,
)
from nvsf_core.stages.views.instances import boxes_of, instance_arrays
from nvsf_core.stages.views.lidar import (
    along_recorded_rays,
    copied_scans,
    copied_sweeps,
    own_panos,
    sweep_arrays,
    warm_up,
)
from nvsf_core.stages.views.view import (
    View,
    asked_view,
    camera_models,
    held_out_view,
    placed,
    view_attrs,
)

MODEL, REPROJECT, COPY, MESH = "model", "reproject", "copy_nearest", "mesh"
NO_LIDAR = "not rendered: this drive has no LiDAR"
_NO_MESH = "not run: there is no mesh, for open3d was absent; install it and run the stage `mesh` again"


def run(task: Task) -> StageOutput:
    """Render the held-out frames and the asked views; the stage `novel_views`."""
    recording = read_recording(task.store)
    models = {MODEL: load_model(task, recording), REPROJECT: reprojection(recording)}
    output = StageOutput()
    mesh = _mesh(task, recording, output)
    if mesh is not None:
        models[MESH] = mesh
    started = time.perf_counter()
    if recording.lidar is not None:
        warm_up(recording.lidar, [one.lidar for one in models.values() if one.lidar is not None])
    output.metadata["warm_up_seconds"] = time.perf_counter() - started
    held_out = held_out_view(recording, task.scene.test_frames)
    if held_out is not None:
        _render_held_out(task, recording, held_out, models, output)
    asked = [(entry, asked_view(recording, entry)) for entry in task.scene.views]
    models, said = with_images(task, recording, models, [view for _, view in asked])
    output.metadata |= said
    for entry, view in asked:
        if view is None:
            output.metadata[entry.name] = NO_LIDAR
            task.progress(f"[{task.scene.name}] novel_views: {entry.name} {NO_LIDAR}")
            continue
        say_tilted(task, entry)
        arrays = render_view_arrays(task, recording, view, models[MODEL], MODEL)
        by_images = asks_images(recording, view, models[MODEL])
        _publish(task, recording, view, arrays, output, by_images=by_images)
        known = _known_part(task, recording, entry, view)
        if known is not None:
            _render_beside(task, recording, known, models, arrays)
    return output


def _known_part(task: Task, recording: Recording, entry: ViewEntry, view: View) -> View | None:
    """What there is a truth of in a view: of the demo, whose world is known, all; else images of cameras."""
    if task.scene.sequence == DEMO_SEQUENCE and recording.lidar is not None:
        return view
    images = {camera: view.images[camera] for camera, _ in entry.truth if camera in view.images}
    return replace(view, sweeps=None, images=images) if images else None


def _mesh(task: Task, recording: Recording, output: StageOutput) -> SceneModel | None:
    """The baseline `mesh`; None without one, then `output` says why."""
    try:
        mesh = mesh_baseline(read_mesh(task.store), recording)
    except MissingLibraryError as error:
        output.metadata[MESH] = str(error)
        return None
    if mesh is None:
        record = read_record(task.store.require(MESH)) or {"metadata": {}}
        words = str(record["metadata"].get(MESH, "not run"))
        # An output with those words is made again once open3d is there: this one, only with a mesh.
        output.metadata[MESH] = _NO_MESH if NO_OPEN3D in words else words
    return mesh


def _render_held_out(
    task: Task, recording: Recording, view: View, models: Mapping[str, SceneModel], output: StageOutput
) -> None:
    """Render the held-out frames, which are scored, by the model and the baselines."""
    for method, model in models.items():
        arrays = render_view_arrays(task, recording, view, model, method)
        if recording.lidar is not None and view.sweeps is not None and model.lidar is not None:
            arrays |= along_recorded_rays(recording.lidar, view.sweeps, model)
        if method == MODEL:
            _publish(task, recording, view, arrays, output)
        else:
            _write(task, recording, view, arrays, method)
    copies = copied_images(recording, view.images)
    if recording.lidar is not None and view.sweeps is not None:
        copies |= copied_scans(recording.lidar, view.sweeps)
    _write(task, recording, view, copies, COPY)


def _render_beside(
    task: Task, recording: Recording, view: View, models: Mapping[str, SceneModel],
    by_model: Mapping[str, np.ndarray],
) -> None:  # fmt: skip
    """Render by the baselines too what there is a truth of, so that all can be scored."""
    for method, model in models.items():
        if method != MODEL:
            _write(task, recording, view, render_view_arrays(task, recording, view, model, method), method)
    copies = copied_images(recording, view.images)
    if recording.lidar is not None and view.sweeps is not None and view.sweeps.is_recorded_sensor:
        copies |= copied_sweeps(recording.lidar, view.sweeps, by_model)
    if copies:
        _write(task, recording, view, copies, COPY)


def _publish(
    task: Task, recording: Recording, view: View, arrays: dict[str, np.ndarray], output: StageOutput, *,
    by_images: bool = False,
) -> None:  # fmt: skip
    """Write the model's arrays, scan and image files of a view, and describe them in `output`."""
    attrs = view_attrs(recording, view, by_images=by_images)
    arrays = arrays | placed(recording, view)
    instances, table = instance_arrays(arrays, camera_models(attrs), boxes_of(task.store))
    arrays, attrs = arrays | instances, attrs | {"instances": table}
    write_method(task, view.name, MODEL, arrays, attrs, recording.trajectory.scene_to_world)
    folder = task.folder / view.name
    if "points_m" in arrays:
        write_scans(folder, view.plan.number.tolist(), scans_of(arrays))
    write_images(folder, arrays)
    describe_view(output, view.name, folder, arrays)


def _write(task: Task, recording: Recording, view: View, arrays: dict[str, np.ndarray], method: str) -> None:
    attrs = view_attrs(recording, view)
    arrays = arrays | placed(recording, view)
    write_method(task, view.name, method, arrays, attrs, recording.trajectory.scene_to_world)


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
            arrays |= own_panos(task, view.plan.poses(recording.trajectory), view.sweeps, model.pano)
    if model.camera is not None:
        arrays |= image_arrays(task, recording, view, model.camera, method)
    return arrays


def say_tilted(task: Task, entry: ViewEntry) -> None:
    """Say where a file's poses turn the LiDAR over: they are rendered, but are hardly what is meant."""
    words = "" if entry.pose_file is None else tilted_words(entry.pose_file.poses)
    if words:
        task.progress(f"[{task.scene.name}] view {entry.name}: {words}")


def with_images(
    task: Task, recording: Recording, models: Mapping[str, SceneModel], asked: Sequence[View | None]
) -> tuple[dict[str, SceneModel], dict[str, Scalar]]:
    """The models, all but the mesh with surfaces above the recorded lasers, found by images; and metadata."""
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


def check(task: Task) -> list[Check]:
    """Check the views in the task's folder: numbers, images, ghosts of the recording vehicle, support."""
    return [*check_views(task), *check_images(task), *check_ghosts(task), *check_support(task)]
