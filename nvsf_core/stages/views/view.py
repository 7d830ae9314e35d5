"""Views: sensors and instants of each, rendering them beside each other, and what is stored of them."""

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from nvsf_core.drives.view_entry import NO_SENSOR, ViewEntry
from nvsf_core.drives.view_parts import CameraEntry
from nvsf_core.errors import DataError
from nvsf_core.geometry.fisheye import MeiFisheye
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.geometry.se3 import rotation_of
from nvsf_core.kernels.threads import MOST_VIEWS, in_parts
from nvsf_core.metrics.table import HELD_OUT
from nvsf_core.recording.drive import Recording
from nvsf_core.recording.images import CameraRecording
from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.sensors.sweep_clock import SweepClock
from nvsf_core.simulation.scan import measured_range_noise_m
from nvsf_core.simulation.view_plan import SweepPlan, ViewPlan, plan_sweeps, plan_view
from nvsf_core.stages.runner.stage import Task
from nvsf_core.stores.arrays import holds_array, read_arrays, read_attrs

_One = TypeVar("_One")
_PATH = ("path_knot_s", "path_to_world")


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """One view: the instants to render, by sensor."""

    plan: ViewPlan
    """Instants whose poses are published: those of the sweeps, or without sweeps of the images."""
    sweeps: SweepPlan | None
    """None if no LiDAR is simulated."""
    images: dict[str, ViewPlan]
    """Recorded camera to the instants of its images."""
    other_cameras: dict[str, CameraEntry] = field(default_factory=dict)
    """Cameras of other intrinsics, at all instants of the plan."""

    @property
    def name(self) -> str:
        """Name of the view."""
        return self.plan.name


def held_out_view(recording: Recording, test_frames: Sequence[int]) -> View | None:
    """The view of the held-out frames, for each sensor those that it recorded; None if there are none.

    Images are asked for where and when they were taken: they may have times of their own.
    """

    def plan_of(recorded: np.ndarray) -> ViewPlan | None:
        wanted = np.array([one for one in test_frames if one in recorded], np.int64)
        if len(wanted) == 0:
            return None
        frame_s = recording.posed_time_s[np.searchsorted(recording.posed_frame, wanted)]
        return ViewPlan(HELD_OUT, wanted, frame_s, None)

    scanned = None if recording.lidar is None else plan_of(recording.lidar.sweeps.arrays["frame"])
    planned = {
        name: _as_taken(plan_of(camera.recorded_frame), camera) for name, camera in recording.cameras.items()
    }
    images = {name: plan for name, plan in planned.items() if plan is not None}
    plan = scanned
    if plan is None and images:
        plan = plan_of(np.concatenate([one.frame for one in images.values()]))
    if plan is None:
        return None
    sweeps = None
    if recording.lidar is not None and scanned is not None:
        sweeps = plan_sweeps(scanned, recording.lidar.sweeps.table, None)
    return View(plan=plan, sweeps=sweeps, images=images)


def _as_taken(plan: ViewPlan | None, camera: CameraRecording) -> ViewPlan | None:
    """The plan of a camera's images, at their own instants and poses if these are not their frames'."""
    if plan is None:
        return None
    row = np.searchsorted(camera.recorded_frame, plan.frame)
    own_s = camera.recorded_time_s[row]
    if np.array_equal(own_s, plan.time_s):
        return plan
    # A mounting read from a file is a rotation only up to 1e-10, so its inverse is not its transpose.
    given = camera.recorded_pose[row] @ np.linalg.inv(camera.in_lidar)
    return replace(plan, time_s=own_s, given_poses=given)


def asked_view(recording: Recording, entry: ViewEntry) -> View | None:
    """A view of the catalogue; None if it asks for sensors of which the drive has none.

    Raises:
        MissingFrameError: It asks for a frame without a pose.
        DataError: It asks for a camera that the drive has no images of.
    """
    plan = plan_view(entry, recording.posed_frame, recording.posed_time_s, recording.trajectory)
    lidar = recording.lidar
    sweeps = None
    if lidar is not None and entry.sensor != NO_SENSOR:
        sweeps = plan_sweeps(plan, lidar.sweeps.table, entry.sensor, has_footprint=entry.footprint)
    # Unless cameras are named, a view with another LiDAR is about that LiDAR's data only.
    is_other = entry.sensor_name not in (None, NO_SENSOR) and (
        sweeps is None or not sweeps.is_recorded_sensor
    )
    names = () if is_other or entry.camera else tuple(recording.cameras)
    images = dict.fromkeys(names if entry.cameras is None else entry.cameras, plan)
    other = {camera.name: camera for camera in entry.camera}
    absent = sorted({*images, *(one.like for one in other.values())} - set(recording.cameras))
    if absent:
        raise DataError(
            f"view {entry.name!r}: expected cameras among {', '.join(recording.cameras) or 'none'}, found "
            f"{', '.join(absent)}; the drive has no usable image of it"
        )
    if sweeps is None and not images and not other:
        return None
    return View(plan=plan, sweeps=sweeps, images=images, other_cameras=other)


def plan_arrays(plan: ViewPlan) -> dict[str, np.ndarray]:
    """Arrays of the data contract on a plan: its instants, and its path if it is not the drive's."""
    arrays = {
        "number": plan.number,
        "frame": plan.frame, "time_s": plan.time_s, "path_time_s": plan.moments_s, "stamp_s": plan.stamp_s,
    }  # fmt: skip
    if plan.path is not None:
        arrays["path_knot_s"] = plan.path.times_s
        arrays["path_to_world"] = plan.path.lidar_to_world
    return arrays


def plan_attrs(plan: ViewPlan) -> dict[str, Any]:
    """Attributes of the data contract on a plan."""
    mount = None if plan.mount is None else plan.mount.reshape(-1).tolist()
    return {"scene_rate": plan.scene_rate, "path_rate": plan.path_rate, "mount": mount}


def stored_plan(path: Path, attrs: Mapping[str, Any] | None = None) -> ViewPlan:
    """The plan of a stored view; its path is in the world."""
    attrs = read_attrs(path) if attrs is None else attrs
    a = read_arrays(path, "frame", "time_s", "path_time_s")
    own = None
    if holds_array(path, _PATH[0]):
        knots = read_arrays(path, *_PATH)
        own = Trajectory(knots["path_knot_s"], knots["path_to_world"], np.eye(4))
    mount = None if attrs["mount"] is None else np.array(attrs["mount"], np.float64).reshape(4, 4)
    return ViewPlan(
        path.parent.name, a["frame"], a["time_s"], mount, path_time_s=a["path_time_s"], path=own,
        scene_rate=float(attrs["scene_rate"]), path_rate=float(attrs["path_rate"]),
    )  # fmt: skip


def placed(recording: Recording, view: View) -> dict[str, np.ndarray]:
    """Arrays of the data contract on a view's instants and poses."""
    poses = recording.trajectory.scene_to_world @ view.plan.poses(recording.trajectory)
    return plan_arrays(view.plan) | {"lidar_to_world": poses} | _clocks(recording, view)


def _clocks(recording: Recording, view: View) -> dict[str, np.ndarray]:
    """The clocks of a view's sweeps, where the recording sensor has one that is not the usual."""
    if recording.lidar is None or view.sweeps is None or not view.sweeps.is_recorded_sensor:
        return {}
    sweeps = recording.lidar.sweeps
    clocks = [sweeps.clock_near(time_s) for time_s in view.plan.near.tolist()]
    return {} if set(clocks) <= {SweepClock()} else {"sweep_clock": np.array(clocks, np.float64)}


def view_attrs(recording: Recording, view: View, *, by_images: bool = False) -> dict[str, Any]:
    """Attributes of the data contract on a view's plan and sensors.

    `by_images`: images supplied the rays above the recorded lasers.
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
    trained = np.repeat(sweeps.is_training, np.diff(a["offsets"]))
    noise_m = measured_range_noise_m(
        a["range_m"], np.where(trained, a["laser"], -1), a["firing"], a["offsets"]
    )
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


def camera_in_lidar(camera: CameraEntry, like: np.ndarray) -> np.ndarray:
    """Mounting (4, 4), camera to LiDAR, of a camera beside the recorded one mounted at `like`."""
    mounted = like.copy()
    mounted[:3, :3] = rotation_of(camera.yaw_deg, camera.pitch_deg, camera.roll_deg) @ like[:3, :3]
    mounted[:3, 3] += camera.shift_m
    return mounted


def camera_models(attrs: Mapping[str, Any]) -> dict[str, Pinhole | MeiFisheye]:
    """Models of a stored view's cameras, of its attributes."""
    return {name: _camera_model(facts) for name, facts in attrs["camera_models"].items()}


def _camera_model(facts: Mapping[str, Any]) -> Pinhole | MeiFisheye:
    values = {name: value for name, value in facts.items() if name != "kind"}
    return Pinhole(**values) if facts["kind"] == "pinhole" else MeiFisheye(**values)


def render_all(
    task: Task, render: Callable[[int], _One], count: int, name: str, *, at_once: int = MOST_VIEWS
) -> tuple[list[_One], np.ndarray]:
    """What `render` gives for the numbers 0 to `count` - 1, and the seconds (count,) that each took.

    Several are rendered at once, so each is said to take an equal share of the time of all.

    Args:
        task: Task of the stage, for its progress.
        render: Renders one.
        count: How many.
        name: Of view, method and sensor, for progress.
        at_once: Most that are rendered at once.
    """
    started, done, lock = time.perf_counter(), 0, threading.Lock()

    def one(number: int) -> _One:
        nonlocal done
        found = render(number)
        with lock:
            done += 1
            seconds = (time.perf_counter() - started) / done
            task.progress(f"[{task.scene.name}] novel_views: {name} {done}/{count}, {seconds:.2f} s each")
        return found

    found = in_parts(one, count, at_once)
    return found, np.full(count, (time.perf_counter() - started) / max(1, count))
