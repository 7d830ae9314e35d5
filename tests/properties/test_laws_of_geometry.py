"""Laws of poses, angles, cameras and panos, over generated inputs."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from benchmarks.numerics.cases.geometry import KITTI_360
from benchmarks.numerics.cases.tolerances import LENGTH_M, SHIFTED_POSE_M
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.geometry.se3 import (
    exp_se3,
    invert_pose,
    log_se3,
    pose_of_angles,
    transform_points,
)
from nvsf_core.sensors.beam_table import encoder_angle, recorded_ray_of_points, wrap_angle
from nvsf_core.sensors.linear_pano import LinearPano, nearest_in_cells
from nvsf_core.sensors.sweep import Trajectory, sweep_fraction
from nvsf_core.sensors.tables import HDL_64E

LAW = settings(derandomize=True, deadline=None, max_examples=40, database=None)
CAMERA = Pinhole(fx=552.55, fy=552.55, cx=682.05, cy=238.77, width=1408, height=376)


def _vectors(largest: float) -> st.SearchStrategy[np.ndarray]:
    return arrays.arrays(np.float64, 3, elements=st.floats(-largest, largest))


@st.composite
def twists(draw: st.DrawFn, most_rad: float = math.pi) -> np.ndarray:
    """Motions of up to 10 m, turning by up to `most_rad`."""
    axis = draw(_vectors(1.0))
    assume(np.linalg.norm(axis) > 1e-3)
    angle = draw(st.one_of(st.floats(0.0, most_rad), st.sampled_from([0.0, 1e-12, 1e-9, 1e-3, most_rad])))
    return np.concatenate([draw(_vectors(10.0)), axis / np.linalg.norm(axis) * angle])


@LAW
@given(twists())
def test_a_twists_exponential_is_rigid_and_its_logarithm_leads_back(twist: np.ndarray) -> None:
    motion = exp_se3(twist)
    rotation = motion[:3, :3]
    assert np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-12 and np.linalg.det(rotation) > 0.0
    assert motion[3].tolist() == [0.0, 0.0, 0.0, 1.0]
    assert np.abs(exp_se3(log_se3(motion)) - motion).max() < LENGTH_M


@LAW
@given(twists(3.0))
def test_the_logarithm_undoes_the_exponential(twist: np.ndarray) -> None:
    assert np.abs(log_se3(exp_se3(twist)) - twist).max() < LENGTH_M


@LAW
@given(twists(), twists())
def test_the_inverse_undoes_a_motion_from_both_sides(a: np.ndarray, b: np.ndarray) -> None:
    pose = exp_se3(a) @ exp_se3(b)
    for product in (pose @ invert_pose(pose), invert_pose(pose) @ pose):
        assert np.abs(product - np.eye(4)).max() < LENGTH_M


@LAW
@given(twists(2.5), st.floats(-1.0, 2.0), st.floats(-1.0, 2.0))
def test_motions_along_one_twist_add_up(twist: np.ndarray, a: float, b: float) -> None:
    assert np.abs(exp_se3(a * twist) @ exp_se3(b * twist) - exp_se3((a + b) * twist)).max() < LENGTH_M


@LAW
@given(twists(), _vectors(100.0), _vectors(100.0))
def test_motions_keep_distances(twist: np.ndarray, a: np.ndarray, b: np.ndarray) -> None:
    moved = transform_points(exp_se3(twist), np.stack([a, b]))
    assert np.linalg.norm(moved[0] - moved[1]) == pytest.approx(np.linalg.norm(a - b), abs=LENGTH_M)


@LAW
@given(_vectors(5e6), st.floats(-180.0, 180.0), twists(1.0), st.floats(-0.05, 0.25))
def test_rays_do_not_notice_where_the_world_begins_and_where_its_north_is(
    shift: np.ndarray, heading_deg: float, step: np.ndarray, when_s: float
) -> None:
    rays = []
    for frame in (np.eye(4), pose_of_angles(tuple(shift), heading_deg, 0.0, 0.0)):
        poses = frame @ np.stack([np.eye(4), exp_se3(step), exp_se3(step) @ exp_se3(step)])
        trajectory = Trajectory(np.array([0.0, 0.1, 0.2]), poses, frame)
        origin, direction = trajectory.move_rays(
            np.array([[0.0, 0.0, 0.2]]), np.array([[0.6, 0.0, 0.8]]), np.array([when_s])
        )
        rays.append(origin + 80.0 * direction)
    assert np.abs(rays[0] - rays[1]).max() < SHIFTED_POSE_M


@LAW
@given(st.one_of(st.floats(-1e3, 1e3), st.integers(-50, 50).map(lambda k: k * math.pi)), st.integers(-2, 2))
def test_wrapped_angles_are_the_same_angle_in_their_interval(angle: float, floats: int) -> None:
    for _ in range(abs(floats)):
        angle = math.nextafter(angle, math.copysign(math.inf, floats))
    wrapped = float(wrap_angle(np.array(angle)))
    assert -math.pi < wrapped <= math.pi
    assert math.cos(wrapped - angle) > 1.0 - 1e-12
    assert -0.5 <= float(sweep_fraction(np.array(angle))) < 0.5


@LAW
@given(_vectors(100.0), st.integers(-1, 63))
def test_a_recorded_ray_ends_on_its_point(point: np.ndarray, laser: int) -> None:
    origin, direction, range_m = recorded_ray_of_points(HDL_64E, point[None], np.array([laser]))
    assert np.abs(origin + direction * range_m[:, None] - point).max() < LENGTH_M
    assert np.isfinite(encoder_angle(HDL_64E, point[None], np.array([laser]))).all()


@LAW
@given(st.floats(0.0, 116.8), st.floats(0.0, 2 * math.pi), st.floats(1e-3, 1e4))
def test_a_fisheyes_pixel_does_not_depend_on_the_distance(angle: float, turn: float, length: float) -> None:
    a = math.radians(angle)
    towards = np.array([math.sin(a) * math.cos(turn), math.sin(a) * math.sin(turn), math.cos(a)])
    near, far = (KITTI_360.project(x[None])[0][0] for x in (towards, towards * length))
    assert np.isfinite(near).all() and np.abs(near - far).max() < 1e-6
    if angle <= 100.0:
        back, solved = KITTI_360.unproject(near[None])
        assert solved[0] and np.abs(back[0] - towards).max() < 1e-7


@LAW
@given(st.floats(-500.0, 2000.0), st.floats(-500.0, 900.0), st.floats(1e-3, 1e6))
def test_a_pinholes_ray_projects_onto_its_pixel(u: float, v: float, depth: float) -> None:
    pixel = np.array([[u, v]])
    back, inside = CAMERA.project(CAMERA.rays(pixel) * depth)
    assert np.abs(back - pixel).max() < 1e-6
    assert bool(inside[0]) == (-0.5 <= back[0, 0] < 1407.5 and -0.5 <= back[0, 1] < 375.5)


@LAW
@given(st.lists(st.tuples(st.integers(0, 20), st.integers(1, 9)), max_size=60))
def test_the_nearest_of_a_cell_wins_and_of_equals_the_first(returns: list[tuple[int, int]]) -> None:
    cell, ranges = (np.array([r[k] for r in returns], dtype=np.int64) for k in range(2))
    found = nearest_in_cells(cell, ranges.astype(np.float32), 21)
    for k in range(21):
        mine = [i for i in range(len(returns)) if returns[i][0] == k]
        assert found[k] == (min(mine, key=lambda i: returns[i][1]) if mine else -1)


@LAW
@given(st.floats(-math.pi, math.pi), st.floats(-24.5, 1.5), st.floats(1.0, 79.0), st.integers(0, 1029))
def test_turning_a_point_by_columns_rolls_its_pano(
    azimuth: float, elevation_deg: float, range_m: float, columns: int
) -> None:
    pano = LinearPano()
    step, elevation = 2 * math.pi / pano.width, math.radians(elevation_deg)
    place = (math.pi - azimuth) / step
    assume(abs(place - math.floor(place) - 0.5) > 1e-6)
    found = []
    for turned in (azimuth, azimuth - columns * step):
        flat_m, up_m = range_m * math.cos(elevation), range_m * math.sin(elevation)
        point = np.array([flat_m * math.cos(turned), flat_m * math.sin(turned), up_m])
        row, column, _, kept = pano.cells(point[None])
        found.append((int(row[0]), int(column[0]), bool(kept[0])))
    assert found[1] == (found[0][0], (found[0][1] + columns) % pano.width, found[0][2])
