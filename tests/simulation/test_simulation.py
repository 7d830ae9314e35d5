"""Laws of simulated sweeps."""

from dataclasses import replace

import numpy as np
import pytest

from nvsf_core.drives.view_entry import ViewEntry
from nvsf_core.errors import MissingFrameError
from nvsf_core.models.baselines.copy_nearest import copied_ranges, nearest_earlier
from nvsf_core.rendering.rendered import RenderedRays
from nvsf_core.sensors.sweep import Trajectory, sweep_rays
from nvsf_core.sensors.tables import HDL_64E, VLP_16
from nvsf_core.simulation.scan import RenderedSweep
from nvsf_core.simulation.view_plan import mount_pose, plan_sweeps, plan_view

FRAMES = np.arange(10, 15)
TIMES = np.arange(5) * 0.1
LEARNED = replace(HDL_64E, range_bias_m=np.full(64, 0.03))
"""The recording sensor, as the drive told it."""


def test_a_scan_is_laser_by_laser_with_ascending_azimuth() -> None:
    rays = still_sweep()
    rendered = RenderedRays(*(np.full(len(rays.laser), v, np.float32) for v in (12.0, 1.0, 0.5)))
    points, intensity, laser = RenderedSweep.of(rays, rendered).scan()
    azimuth = np.arctan2(points[:, 1], points[:, 0]) % (2 * np.pi)
    assert (np.diff(laser) >= 0).all()
    assert (np.diff(azimuth)[np.diff(laser) == 0] >= 0).all()
    assert len(points) == len(rays.laser) and np.allclose(intensity, 0.5)


def test_drops_and_rays_without_an_answer_leave_no_point() -> None:
    rays = still_sweep()
    hit = np.zeros(len(rays.laser), np.float32)
    hit[:7] = 1.0
    range_m = np.full(len(rays.laser), 5.0, np.float32)
    range_m[0] = np.inf
    points, _, _ = RenderedSweep.of(rays, RenderedRays(range_m, hit, np.zeros_like(hit))).scan()
    assert len(points) == 6


def test_a_scan_may_lack_a_laser_or_all_of_them() -> None:
    rays = still_sweep()
    hit = (rays.laser != np.unique(rays.laser)[1]).astype(np.float32)
    range_m = np.full(len(rays.laser), 5.0, np.float32)
    points, _, laser = RenderedSweep.of(rays, RenderedRays(range_m, hit, np.zeros_like(hit))).scan()
    azimuth = np.arctan2(points[:, 1], points[:, 0]) % (2 * np.pi)
    assert len(points) == hit.sum() and np.array_equal(np.lexsort((azimuth, laser)), np.arange(len(laser)))
    nothing = RenderedRays(range_m, 0.0 * hit, np.zeros_like(hit))
    points, intensity, laser = RenderedSweep.of(rays, nothing).scan()
    assert points.shape == (0, 3) and intensity.shape == laser.shape == (0,)


def test_a_shifted_sensor_fires_from_beside_the_car() -> None:
    here, there = still_sweep(), still_sweep(mount_pose(ViewEntry(name="left", shift_m=(0.0, 1.0, 0.0))))
    assert np.allclose(there.origin_m - here.origin_m, [0.0, 1.0, 0.0], atol=1e-5)
    assert np.allclose(there.direction, here.direction, atol=1e-6)


def test_a_view_between_frames_takes_the_time_asked_for() -> None:
    view = plan("between", times_s=(0.15,))
    assert view.time_s.tolist() == [0.15]
    assert view.frame[0] in (11, 12)


def test_a_view_of_another_sensor_says_so() -> None:
    assert plan("v", sensor="VLP-16").table is VLP_16
    own = plan("v", sensor=HDL_64E.name)
    assert own.is_recorded_sensor and own.table is LEARNED
    assert not plan("v", sensor="VLP-16").is_recorded_sensor


def test_a_frame_that_was_never_recorded_is_an_error_that_names_it() -> None:
    with pytest.raises(MissingFrameError, match="99"):
        plan("v", frames=(99,))


def test_of_two_equally_near_recordings_the_earlier_is_copied() -> None:
    assert nearest_earlier(np.array([0.0, 0.2]), 0.1) == 0
    assert nearest_earlier(np.array([0.0, 0.1993]), 0.1) == 0
    assert nearest_earlier(np.array([0.0, 0.15]), 0.1) == 1


@pytest.mark.parametrize(("firings", "aside_m"), [(2172, np.inf), (360, 7.0)])
def test_copying_answers_with_the_same_laser_within_a_fifth_of_a_degree_or_half_a_step(
    firings, aside_m
) -> None:
    def at(degrees: float) -> np.ndarray:
        return np.array([[np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees)), 0.0]])

    source = np.concatenate([at(10.0), at(179.95)])
    found, _ = copied_ranges(
        source, np.array([3, 3]), np.array([7.0, 8.0]), np.array([0.1, 0.2]),
        np.concatenate([at(10.1), at(10.3), at(10.0), at(-179.95)]), np.array([3, 3, 4, 3]),
        firings=firings,
    )  # fmt: skip
    assert found.tolist() == [7.0, aside_m, np.inf, 8.0]


def still_sweep(mount: np.ndarray | None = None):
    trajectory = Trajectory(TIMES, np.tile(np.eye(4), (5, 1, 1)), np.eye(4))
    return sweep_rays(HDL_64E, np.array([0, 30]), 50, trajectory, 0.2, 0.1, mount=mount)


def plan(name: str, frames=None, times_s=None, sensor=None):
    frames = frames or ("all" if times_s is None else ())
    still = Trajectory(TIMES, np.tile(np.eye(4), (len(TIMES), 1, 1)), np.eye(4))
    view = plan_view(ViewEntry(name=name, frames=frames, times_s=times_s), FRAMES, TIMES, still)
    return plan_sweeps(view, LEARNED, sensor)
