"""Stage `novel_views`: the held-out frames and every view that was asked for, rendered."""

import time
from dataclasses import dataclass

import numpy as np
import torch

from nvsf_core.errors import DataError
from nvsf_core.evidence.scene_evidence import SceneEvidence
from nvsf_core.fields.camera_field import CameraField
from nvsf_core.fields.lidar_field import LidarField
from nvsf_core.kitti360.catalogue import ViewEntry
from nvsf_core.rendering.reproject_camera import render_by_warping
from nvsf_core.sensors.linear_pano import LinearPano
from nvsf_core.simulation.camera_view import render_image
from nvsf_core.simulation.copying import copied_ranges, nearest_earlier
from nvsf_core.simulation.sweep_simulation import (
    Renderer,
    SimulatedSweep,
    answer_in_chunks,
    evidence_renderer,
    field_renderer,
    simulate_sweep,
)
from nvsf_core.simulation.view_plan import ViewPlan, plan_view
from nvsf_core.stages.evidence import Sweeps, read_evidence, read_sweeps
from nvsf_core.stages.field import STAGE as FIELD_STAGE
from nvsf_core.stages.field import far_m, load_fields, read_images, training_frames
from nvsf_core.stages.stage import Stage, StageOutput, Task
from nvsf_core.stages.view_files import describe_view, export_files, write_method
from nvsf_core.stores.tables import read_rows
from nvsf_core.training.pixels import CameraImages

TEST = "test"
_DEPTH_SCANS = 10
"""Training scans around a view whose returns give the warped images their depth."""


@dataclass(frozen=True, slots=True)
class _Scene:
    """Everything that rendering reads."""

    sweeps: Sweeps
    evidence: SceneEvidence
    lidar: LidarField
    camera: CameraField | None
    images: dict[str, tuple[CameraImages, np.ndarray]]
    camera_in_lidar: dict[str, np.ndarray]
    posed_frame: np.ndarray
    posed_time_s: np.ndarray


def _run(task: Task) -> StageOutput:
    torch.set_num_threads(task.config.recipe.lidar_training.threads)
    scene = _read(task)
    output = StageOutput()
    started = time.perf_counter()
    # The first call of a compiled kernel loads it; that is no part of a frame's render time.
    _warm_up(task, scene)
    output.metadata["warm_up_seconds"] = time.perf_counter() - started
    test = tuple(frame for frame in task.scene.test_frames if frame in scene.sweeps.arrays["frame"])
    if test:
        _render_test(task, scene, test, output)
    for view in task.scene.views:
        _render_view(task, scene, view, output)
    return output


def _render_test(task: Task, scene: _Scene, frames: tuple[int, ...], output: StageOutput) -> None:
    """The held-out frames, by the model and by both baselines."""
    plan = _plan(scene, TEST, frames=frames)
    recipe = task.config.recipe
    limit = far_m(scene.sweeps)
    most = recipe.evidence.lidar_candidates
    model = field_renderer(scene.lidar, scene.evidence.surfels, most=most, far_m=limit)
    evidence = evidence_renderer(scene.evidence.surfels, most=most, far_m=limit)
    folder = task.folder / TEST
    for method, render in (("model", model), ("reproject", evidence)):
        arrays = _lidar_arrays(task, scene, plan, render, method) | _along_recorded_rays(
            task, scene, plan, render
        )
        cameras = _camera_arrays(task, scene, plan, method)
        write_method(
            folder,
            method,
            task,
            plan,
            _world_poses(scene, plan),
            scene.sweeps.scene_origin_m,
            arrays | cameras,
        )
        if method == "model":
            export_files(folder, arrays, cameras, plan)
            describe_view(output, TEST, folder, arrays, cameras)
    write_method(
        folder,
        "copy_nearest",
        task,
        plan,
        _world_poses(scene, plan),
        scene.sweeps.scene_origin_m,
        _copied(task, scene, plan),
    )


def _render_view(task: Task, scene: _Scene, view: ViewEntry, output: StageOutput) -> None:
    """One view that was asked for, by the model."""
    frames = None if view.frames == "all" else tuple(int(frame) for frame in view.frames)
    plan = _plan(
        scene, view.name, frames=frames, times_s=view.times_s, sensor=view.sensor, shift_m=view.shift_m,
        yaw_deg=view.yaw_deg,
    )  # fmt: skip
    most = task.config.recipe.evidence.lidar_candidates
    render = field_renderer(scene.lidar, scene.evidence.surfels, most=most, far_m=far_m(scene.sweeps))
    arrays = _lidar_arrays(task, scene, plan, render, "model")
    # A view with another LiDAR asks for that LiDAR's data; the cameras have not changed.
    cameras = _camera_arrays(task, scene, plan, "model") if plan.is_recorded_sensor else {}
    folder = task.folder / view.name
    write_method(
        folder, "model", task, plan, _world_poses(scene, plan), scene.sweeps.scene_origin_m, arrays | cameras
    )
    export_files(folder, arrays, cameras, plan)
    describe_view(output, view.name, folder, arrays, cameras)


def _plan(
    scene: _Scene,
    name: str,
    *,
    frames: tuple[int, ...] | None = None,
    times_s: tuple[float, ...] | None = None,
    sensor: str | None = None,
    shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    yaw_deg: float = 0.0,
) -> ViewPlan:
    return plan_view(
        name, recorded_frame=scene.posed_frame, recorded_time_s=scene.posed_time_s,
        recorded_table=scene.sweeps.table, frames=frames, times_s=times_s, sensor=sensor, shift_m=shift_m,
        yaw_deg=yaw_deg,
    )  # fmt: skip


def _lidar_arrays(
    task: Task, scene: _Scene, plan: ViewPlan, render: Renderer, method: str
) -> dict[str, np.ndarray]:
    """All sweeps of a view, joined."""
    sweeps: list[SimulatedSweep] = []
    seconds = []
    for number, instant in enumerate(plan.time_s):
        started = time.perf_counter()
        sweeps.append(
            simulate_sweep(
                plan,
                float(instant),
                scene.evidence,
                render,
                scene.sweeps.trajectory,
                scene.sweeps.period_s,
                scene.sweeps.table,
                task.config.recipe.evidence.votes,
            )
        )
        seconds.append(time.perf_counter() - started)
        task.progress(
            f"[{task.scene.name}] novel_views: {plan.name}, {method}, sweep {number + 1}/{len(plan.time_s)}, "
            f"{len(sweeps[-1].points_m):,} returns in {seconds[-1]:.2f} s"
        )
    arrays = _joined([(s.points_m, s.intensity, s.laser) for s in sweeps])
    arrays["lidar_render_seconds"] = np.array(seconds)
    for name in ("pano_range_m", "pano_intensity", "pano_hit"):
        arrays[name] = np.stack([getattr(s, name) for s in sweeps])
    shapes = {s.grid["grid_hit"].shape for s in sweeps}
    firings = max(shape[1] for shape in shapes)
    for name in sweeps[0].grid:
        # Sweeps differ by a firing or two: the short ones end in cells that never hit.
        padded = [np.pad(s.grid[name], ((0, 0), (0, firings - s.grid[name].shape[1]))) for s in sweeps]
        arrays[name] = np.stack(padded)
    return arrays


def _along_recorded_rays(
    task: Task, scene: _Scene, plan: ViewPlan, render: Renderer
) -> dict[str, np.ndarray]:
    """For scoring only: range and intensity along the recorded returns' own rays."""
    a = scene.sweeps.arrays
    ranges, intensities = [], []
    for frame, instant in zip(plan.frame, plan.time_s, strict=True):
        part = scene.sweeps.returns_of(int(np.flatnonzero(a["frame"] == frame)[0]))
        scans = scene.evidence.prior.nearest_scans(float(instant), task.config.recipe.evidence.votes)
        laser = np.maximum(a["laser"][part], 0)
        vote = scene.evidence.prior.vote(laser, a["sweep_fraction"][part], scans)
        answers = answer_in_chunks(render, a["origin_m"][part], a["direction"][part], vote)
        ranges.append(answers.range_m)
        intensities.append(answers.intensity)
    return {
        "ray_offsets": _offsets([len(r) for r in ranges]),
        "ray_range_m": np.concatenate(ranges).astype(np.float32),
        "ray_intensity": np.concatenate(intensities).astype(np.float32),
    }


def _camera_arrays(task: Task, scene: _Scene, plan: ViewPlan, method: str) -> dict[str, np.ndarray]:
    """Images of every camera at every instant of the plan."""
    arrays: dict[str, np.ndarray] = {}
    for name, (training, _) in scene.images.items():
        shown, seconds = [], []
        for number, instant in enumerate(plan.time_s):
            pose = _camera_pose(scene, name, plan, float(instant))
            started = time.perf_counter()
            shown.append(_image(task, scene, training, pose, float(instant), method))
            seconds.append(time.perf_counter() - started)
            task.progress(
                f"[{task.scene.name}] novel_views: {plan.name}, {method}, {name} "
                f"{number + 1}/{len(plan.time_s)}, {seconds[-1]:.2f} s"
            )
        arrays[f"{name}_rgb"] = np.stack(shown)
        arrays[f"{name}_frame"] = plan.frame
        arrays[f"{name}_render_seconds"] = np.array(seconds)
    return arrays


def _image(
    task: Task, scene: _Scene, training: CameraImages, pose: np.ndarray, instant_s: float, method: str
) -> np.ndarray:
    if method == "model" and scene.camera is not None:
        return render_image(scene.camera, scene.evidence.surfels, training.pinhole, pose, task.config.recipe)
    points = _depth_points(scene, instant_s)
    valid = np.zeros(training.pinhole.height * training.pinhole.width, bool)
    valid[training.pixel] = True
    shape = (training.pinhole.height, training.pinhole.width)
    rgb, _ = render_by_warping(
        pose, training.pinhole, points, training.rgb, training.pose, source_valid=valid.reshape(shape)
    )
    return rgb


def _depth_points(scene: _Scene, instant_s: float) -> np.ndarray:
    """Returns (m, 3) scene-local of the training scans around an instant, without the own vehicle."""
    a = scene.sweeps.arrays
    training = np.flatnonzero(scene.sweeps.is_training)
    near = training[np.argsort(np.abs(a["time_s"][training] - instant_s), kind="stable")[:_DEPTH_SCANS]]
    parts = []
    for scan in near:
        part = scene.sweeps.returns_of(int(scan))
        seen = ~a["is_own_vehicle"][part]
        parts.append(a["origin_m"][part][seen] + a["direction"][part][seen] * a["range_m"][part][seen, None])
    return np.concatenate(parts).astype(np.float32)


def _copied(task: Task, scene: _Scene, plan: ViewPlan) -> dict[str, np.ndarray]:
    """The nearest training scan and image, as they are."""
    a = scene.sweeps.arrays
    training = np.flatnonzero(scene.sweeps.is_training)
    pano = LinearPano(quirks=True)
    scans, panos, rays, seconds = [], [], [], []
    for frame, instant in zip(plan.frame, plan.time_s, strict=True):
        started = time.perf_counter()
        source = scene.sweeps.returns_of(
            int(training[nearest_earlier(a["time_s"][training], float(instant))])
        )
        scans.append((a["points_m"][source], a["intensity"][source], a["laser"][source]))
        panos.append(pano.project(a["points_m"][source], a["intensity"][source]))
        seconds.append(time.perf_counter() - started)
        own = scene.sweeps.returns_of(int(np.flatnonzero(a["frame"] == frame)[0]))
        rays.append(
            copied_ranges(
                a["points_m"][source],
                a["laser"][source],
                a["range_m"][source],
                a["intensity"][source],
                a["points_m"][own],
                a["laser"][own],
            )
        )
    arrays = _joined(scans)
    arrays["pano_range_m"] = np.stack([range_m for range_m, _ in panos])
    arrays["pano_intensity"] = np.stack([intensity for _, intensity in panos])
    arrays["pano_hit"] = (arrays["pano_range_m"] > 0).astype(np.float32)
    arrays["ray_offsets"] = _offsets([len(r) for r, _ in rays])
    arrays["ray_range_m"] = np.concatenate([r for r, _ in rays])
    arrays["ray_intensity"] = np.concatenate([i for _, i in rays])
    arrays["lidar_render_seconds"] = np.array(seconds)
    time_of = dict(zip(scene.posed_frame.tolist(), scene.posed_time_s.tolist(), strict=True))
    for name, (images, frames) in scene.images.items():
        times = np.array([time_of[int(frame)] for frame in frames])
        arrays[f"{name}_rgb"] = np.stack([images.rgb[nearest_earlier(times, float(t))] for t in plan.time_s])
        arrays[f"{name}_frame"] = plan.frame
        arrays[f"{name}_render_seconds"] = np.zeros(len(plan.time_s))
    return arrays


def _read(task: Task) -> _Scene:
    sweeps, evidence = read_sweeps(task.store), read_evidence(task.store)
    if sweeps is None or evidence is None:
        raise DataError(f"scene {task.scene.name}: views need LiDAR evidence and this drive has no scan")
    lidar, camera = load_fields(task.store, FIELD_STAGE.location(task.config), evidence)
    frames = task.store.require("frames")
    posed = sorted(
        (r for r in read_rows(frames / "frames.parquet") if r["pose_valid"]), key=lambda r: r["frame"]
    )
    lidar_pose = {r["frame"]: np.array(r["lidar_to_world"]).reshape(4, 4) for r in posed}
    mounted: dict[str, np.ndarray] = {}
    for row in read_rows(frames / "cameras.parquet"):
        if row["image_valid"] and row["frame"] in lidar_pose and row["camera"] not in mounted:
            pose = np.array(row["camera_to_world"]).reshape(4, 4)
            mounted[row["camera"]] = np.linalg.inv(lidar_pose[row["frame"]]) @ pose
    return _Scene(
        sweeps=sweeps,
        evidence=evidence,
        lidar=lidar,
        camera=camera,
        images=read_images(task.store, sweeps.scene_origin_m, training_frames(task.store)),
        camera_in_lidar=mounted,
        posed_frame=np.array([r["frame"] for r in posed], np.int64),
        posed_time_s=np.array([r["time_s"] for r in posed]),
    )


def _lidar_pose(scene: _Scene, plan: ViewPlan, instant_s: float) -> np.ndarray:
    """Scene-local pose (4, 4) of the view's LiDAR."""
    rotation, position = scene.sweeps.trajectory.at(np.array([instant_s]))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation[0], position[0]
    return pose if plan.mount is None else pose @ plan.mount


def _world_poses(scene: _Scene, plan: ViewPlan) -> np.ndarray:
    """True world poses (n, 4, 4) of the view's LiDAR."""
    poses = np.stack([_lidar_pose(scene, plan, float(instant)) for instant in plan.time_s])
    poses[:, :3, 3] += scene.sweeps.scene_origin_m
    return poses


def _camera_pose(scene: _Scene, camera: str, plan: ViewPlan, instant_s: float) -> np.ndarray:
    return np.asarray(_lidar_pose(scene, plan, instant_s) @ scene.camera_in_lidar[camera])


def _warm_up(task: Task, scene: _Scene) -> None:
    a = scene.sweeps.arrays
    most = task.config.recipe.evidence.lidar_candidates
    for render in (
        field_renderer(scene.lidar, scene.evidence.surfels, most=most, far_m=1.0),
        evidence_renderer(scene.evidence.surfels, most=most, far_m=1.0),
    ):
        render(a["origin_m"][:64], a["direction"][:64], np.ones(len(a["origin_m"][:64]), np.float32))


def _joined(scans: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> dict[str, np.ndarray]:
    return {
        "offsets": _offsets([len(points) for points, _, _ in scans]),
        "points_m": np.concatenate([points for points, _, _ in scans]),
        "intensity": np.concatenate([intensity for _, intensity, _ in scans]),
        "laser": np.concatenate([laser for _, _, laser in scans]),
    }


def _offsets(lengths: list[int]) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)


STAGE = Stage(
    name="novel_views",
    group="synthesis",
    inputs=("frames", "sweeps", "undistorted", "evidence", "field"),
    description="Rendered LiDAR scans and images of the held-out frames, with the baselines, and of every "
    "view that was asked for.",
    version="2",
    run=_run,
    per_recipe=True,
    reads_views=True,
)
