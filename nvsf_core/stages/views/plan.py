"""Sensors and instants of the views: the held-out frames, and each view of the catalogue."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nvsf_core.drives.catalogue import ViewEntry
from nvsf_core.metrics.table import HELD_OUT
from nvsf_core.recording.drive import Recording
from nvsf_core.simulation.view_plan import SweepPlan, ViewPlan, plan_sweeps, plan_view


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """One view: the instants to render, by sensor."""

    plan: ViewPlan
    """Instants whose poses are published: those of the sweeps, or without sweeps of the images."""
    sweeps: SweepPlan | None
    """None if no LiDAR is simulated."""
    images: dict[str, ViewPlan]
    """Camera to the instants of its images."""

    @property
    def name(self) -> str:
        """Name of the view."""
        return self.plan.name


def held_out_view(recording: Recording, test_frames: Sequence[int]) -> View | None:
    """The view of the held-out frames, for each sensor those that it recorded; None if there are none."""

    def plan_of(recorded: np.ndarray) -> ViewPlan | None:
        wanted = tuple(frame for frame in test_frames if frame in recorded)
        return _plan(recording, HELD_OUT, frames=wanted) if wanted else None

    scanned = None if recording.lidar is None else plan_of(recording.lidar.sweeps.arrays["frame"])
    planned = {name: plan_of(camera.recorded_frame) for name, camera in recording.cameras.items()}
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


def asked_view(recording: Recording, entry: ViewEntry) -> View | None:
    """A view of the catalogue; None if it asks for a LiDAR and the drive has none."""
    frames = None if entry.frames == "all" else tuple(int(frame) for frame in entry.frames)
    plan = _plan(
        recording, entry.name, frames=frames, times_s=entry.times_s, frozen_at_s=entry.frozen_at_s,
        shift_m=entry.shift_m, yaw_deg=entry.yaw_deg,
    )  # fmt: skip
    everywhere = dict.fromkeys(recording.cameras, plan)
    if recording.lidar is None:
        return None if entry.sensor else View(plan=plan, sweeps=None, images=everywhere)
    sweeps = plan_sweeps(plan, recording.lidar.sweeps.table, entry.sensor)
    # A view with another LiDAR is about that LiDAR's data only.
    return View(plan=plan, sweeps=sweeps, images=everywhere if sweeps.is_recorded_sensor else {})


def reference_poses(recording: Recording, plan: ViewPlan) -> np.ndarray:
    """(n, 4, 4) scene-local poses of the view's LiDAR; in a camera-only drive of its nominal place."""
    return plan.poses(recording.trajectory)


def to_world(recording: Recording, poses: np.ndarray) -> np.ndarray:
    """Scene-local poses (n, 4, 4) moved to the world, metres."""
    moved = poses.copy()
    moved[:, :3, 3] += recording.scene_origin_m
    return moved


def _plan(
    recording: Recording,
    name: str,
    *,
    frames: tuple[int, ...] | None,
    times_s: tuple[float, ...] | None = None,
    frozen_at_s: float | None = None,
    shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    yaw_deg: float = 0.0,
) -> ViewPlan:
    return plan_view(
        name, recorded_frame=recording.posed_frame, recorded_time_s=recording.posed_time_s, frames=frames,
        times_s=times_s, frozen_at_s=frozen_at_s, shift_m=shift_m, yaw_deg=yaw_deg,
    )  # fmt: skip
