"""Plans of views: paths of one's own, times apart from poses, slowed, frozen, between frames."""

from dataclasses import replace

import numpy as np
import pytest

from nvsf_core.drives.view_entry import ViewEntry
from nvsf_core.drives.view_parts import PoseFile, SensorEntry, Waypoint
from nvsf_core.errors import MissingFrameError
from nvsf_core.geometry.se3 import pose_of_angles, rotation_of
from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.sensors.tables import HDL_64E
from nvsf_core.simulation.view_plan import plan_sweeps, plan_view

FRAMES, TIMES = np.arange(10, 21), np.arange(11) * 0.1
SCENE = pose_of_angles((1000.0, 2000.0, 100.0), 70.0, 0.0, 0.0)
START = pose_of_angles((1003.0, 2001.0, 101.0), 40.0, 0.0, 0.0)
RECORDED = Trajectory(
    TIMES, np.stack([START @ pose_of_angles((10.0 * t, 0.0, 0.0), 0.0, 0.0, 0.0) for t in TIMES]), SCENE
)


def plan(**keys):
    return plan_view(ViewEntry(name="v", **keys), FRAMES, TIMES, RECORDED)


def test_angles_turn_left_then_down_then_right():
    assert np.allclose(rotation_of(90.0, 0.0, 0.0) @ [1, 0, 0], [0, 1, 0])
    assert np.allclose(rotation_of(0.0, 90.0, 0.0) @ [1, 0, 0], [0, 0, -1])
    assert np.allclose(rotation_of(0.0, 0.0, 90.0) @ [0, 1, 0], [0, 0, 1])
    assert np.allclose(rotation_of(90.0, 90.0, 0.0) @ [1, 0, 0], [0, 0, -1])


def test_a_frozen_instant_stops_the_scene_and_not_the_car():
    found = plan(frames=(12, 18), frozen_at_s=0.5)
    assert found.time_s.tolist() == [0.5, 0.5] and np.allclose(found.moments_s, [0.2, 0.8])
    assert found.number.tolist() == [12, 18] and np.allclose(found.stamp_s, [0.2, 0.8])
    along = SCENE[:3, :3].T @ START[:3, 0]
    assert np.allclose(np.diff(found.poses(RECORDED)[:, :3, 3], axis=0), 6.0 * along)
    sweeps = plan_sweeps(found, HDL_64E, None)
    assert np.allclose(sweeps.fired_s(0.5, np.array([-0.5, 0.5]), 0.1), 0.5)
    one = sweeps.only(1)
    assert one.near_time_s(0.5) == pytest.approx(0.8) and one.moment_s(0.5) == pytest.approx(0.8)


def test_frames_in_any_order_are_shown_in_the_order_of_time():
    paths = ({}, {"waypoints": (Waypoint(time_s=0.0, position_m=(0.0, 0.0, 0.0)),)})
    for path in paths:
        found = plan(frames=(18, 12, 14), **path)
        assert np.allclose(found.stamp_s, [0.2, 0.4, 0.8])


def test_a_path_that_lies_at_other_times_than_the_drive_is_refused_with_both_times():
    rows = ((1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0),) * 2
    unix = PoseFile(name="p", time_s=(1369728000.25, 1369728003.5), poses=rows)
    for keys in ({}, {"rate_hz": 10.0}, {"times_s": (0.5,)}):
        with pytest.raises(MissingFrameError, match=r"0 and 1 seconds .* from 1369728000 to 1369728004"):
            plan(pose_file=unix, **keys)


def test_half_speed_shows_twice_as_many_instants_and_stamps_them_by_the_sensors_clock():
    found = plan(rate_hz=10.0, speed=0.5)
    assert np.allclose(np.diff(found.time_s), 0.05) and len(found.time_s) == 21
    assert np.allclose(np.diff(found.stamp_s), 0.1)
    assert found.number.tolist() == list(range(21)), "between frames files count from 0"
    sweeps = plan_sweeps(found, HDL_64E, None)
    assert np.allclose(sweeps.fired_s(0.5, np.array([-0.5, 0.5]), 0.1), [0.475, 0.525])


def test_waypoints_are_met_and_left_without_a_kink():
    points = tuple(
        Waypoint(time_s=t, position_m=(8.0 * t, y, 0.0), yaw_deg=yaw)
        for t, y, yaw in ((0.0, 0.0, 0.0), (0.5, 2.0, 30.0), (1.0, 0.0, 0.0))
    )
    found = plan(waypoints=points, times_s=(0.0, 0.5, 1.0))
    world = SCENE @ found.poses(RECORDED)
    local = np.linalg.inv(START) @ world
    assert np.allclose(local[:, :3, 3], [(0, 0, 0), (4, 2, 0), (8, 0, 0)], atol=1e-6)
    assert np.allclose(local[1, :3, :3], rotation_of(30.0, 0.0, 0.0), atol=1e-6)
    path = found.path
    before, at, after = (path.at(np.array([t]))[1][0] for t in (0.46, 0.5, 0.54))
    assert np.linalg.norm((after - at) - (at - before)) < 0.1
    assert not found.is_as_recorded and found.near_s is not None


def test_a_frozen_path_may_last_longer_than_the_drive_and_another_not():
    points = (Waypoint(time_s=0.0, position_m=(0, 0, 0)), Waypoint(time_s=9.0, position_m=(5.0, 0, 0)))
    assert len(plan(waypoints=points, rate_hz=1.0, frozen_at_s=0.3).time_s) == 10
    with pytest.raises(MissingFrameError, match="from 0 to 1 seconds of the path"):
        plan(waypoints=points, times_s=(5.0,))


def test_a_pose_file_in_the_world_is_the_path():
    poses = (START, START @ pose_of_angles((0.0, 3.0, 0.0), 0.0, 0.0, 0.0))
    rows = tuple(tuple(pose[:3].ravel().tolist()) for pose in poses)
    given = PoseFile(name="p.txt", time_s=(0.0, 1.0), poses=rows)
    found = plan(pose_file=given, path_in="world", times_s=(0.0, 1.0), shift_m=(1.0, 0.0, 0.0))
    world = (SCENE @ found.poses(RECORDED))[:, :3, 3]
    assert np.allclose(world, [(pose @ [1.0, 0.0, 0.0, 1.0])[:3] for pose in poses], atol=1e-6)


def test_a_sensor_of_ones_own_rotates_at_its_own_rate():
    sensor = SensorEntry(name="mine", elevation_deg=(5.0, 0.0, -5.0), azimuth_step_deg=0.5, rate_hz=20.0)
    sweeps = plan_sweeps(plan(frames=(12,)), HDL_64E, sensor)
    assert not sweeps.is_recorded_sensor and sweeps.sweep_s(0.1) == 0.05
    assert (sweeps.table.laser_count, sweeps.table.firings_per_turn) == (3, 720)
    assert plan_sweeps(plan(frames=(12,)), replace(HDL_64E), "HDL-64E").is_recorded_sensor


def _there_and_back(lanes_apart_m):
    """A road of 20 m that is driven there at y = 0 and back on the other lane, a metre a frame."""
    there = [pose_of_angles((float(k), 0.0, 0.0), 0.0, 0.0, 0.0) for k in range(20)]
    back = [pose_of_angles((19.0 - k, lanes_apart_m, 0.0), 180.0, 0.0, 0.0) for k in range(20)]
    return Trajectory(np.arange(40) * 0.1, np.stack([*there, *back]), np.eye(4))


def _nearest_frames(recorded, y_m, **keys):
    """Frames nearest to a path along the road at y_m, from 2 to 12 m; `keys` are the view's."""
    ends = tuple(Waypoint(time_s=t, position_m=(2.0 + 10.0 * t, y_m, 0.0)) for t in (0.0, 1.0))
    view = ViewEntry(name="v", waypoints=ends, path_in="world", times_s=(0.0, 0.5, 1.0), **keys)
    times_s = recorded.times_s
    return plan_view(view, np.arange(len(times_s)), times_s, recorded).frame.tolist()


def test_on_a_road_that_is_driven_there_and_back_frames_that_look_the_same_way_are_near():
    road = _there_and_back(3.0)
    assert _nearest_frames(road, 2.5) == [2, 7, 12], "on the other lane, but looking ahead"
    assert _nearest_frames(road, 0.5, yaw_deg=180.0) == [37, 32, 27], "looking back"
    # Across the road neither is better, and a lane that is far away is another road.
    assert _nearest_frames(road, 2.5, yaw_deg=90.0) == [37, 32, 27]
    assert _nearest_frames(_there_and_back(9.0), 8.0) == [37, 32, 27]


@pytest.mark.parametrize("yaw_deg", [0.0, 90.0, 180.0])
def test_on_a_road_that_is_driven_once_the_nearest_frame_is_near_however_the_sensor_looks(yaw_deg):
    curve = [pose_of_angles((9.0 * np.sin(a), 9.0 - 9.0 * np.cos(a), 0.0), np.rad2deg(a), 0.0, 0.0)
             for a in np.linspace(0.0, 1.5, 14)]  # fmt: skip
    road = Trajectory(np.arange(14) * 0.1, np.stack(curve), np.eye(4))
    places = np.stack(curve)[:, :2, 3]
    expected = [np.linalg.norm(places - [x, 2.5], axis=1).argmin() for x in (2.0, 7.0, 12.0)]
    assert _nearest_frames(road, 2.5, yaw_deg=yaw_deg) == expected
