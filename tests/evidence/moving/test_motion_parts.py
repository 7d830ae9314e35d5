"""Laws of the parts that find motion: ground, registration, smoothing, poses in time."""

import numpy as np

from nvsf_core.evidence.moving.object_evidence import MovingObject
from nvsf_core.evidence.moving.path_fitting import PairMotions, make_cloud, register, smooth_poses
from nvsf_core.evidence.moving.visibility import build_ground


def box_surface(rng: np.random.Generator, count: int) -> np.ndarray:
    """Points on the surface of a box of 4 x 2 x 1.5 m."""
    point = rng.uniform(-0.5, 0.5, (count, 3))
    side = rng.integers(0, 3, count)
    point[np.arange(count), side] = np.sign(point[np.arange(count), side]) * 0.5
    return point * (4.0, 2.0, 1.5)


def turned(point: np.ndarray, yaw_rad: float) -> np.ndarray:
    cosine, sine = np.cos(yaw_rad), np.sin(yaw_rad)
    return point @ np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]]).T


def test_cars_hedges_and_mirror_images_do_not_bend_the_ground() -> None:
    rng = np.random.default_rng(0)
    flat = np.column_stack([rng.uniform(-30, 30, (60_000, 2)), rng.normal(0.0, 0.01, 60_000)])
    covered = (np.abs(flat[:, 0] - 5) < 1.0) & (np.abs(flat[:, 1]) < 2.2)
    roof = np.column_stack([rng.uniform(4, 6, 500), rng.uniform(-2.2, 2.2, 500), np.full(500, 1.5)])
    mirrored = np.column_stack([rng.uniform(-9, -8, (60, 2)), np.full(60, -2.0)])
    slope = 0.02 * flat[~covered, :1]
    points = np.concatenate([flat[~covered] + np.hstack([0 * slope, 0 * slope, slope]), roof, mirrored])
    ground = build_ground(points)
    for x, y in ((0.0, 0.0), (5.0, 0.0), (-8.5, -8.5), (25.0, -20.0)):
        above = ground.above(np.array([[x, y, 0.02 * x + 1.0]]))[0]
        assert abs(above - 1.0) < 0.12


def test_registration_finds_a_known_turn_and_shift() -> None:
    rng = np.random.default_rng(1)
    centre = np.array([20.0, -5.0, 1.0])
    first = make_cloud(box_surface(rng, 400) + centre)
    moved = turned(box_surface(rng, 400), 0.04) + centre + (0.8, 0.1, 0.02)
    pair = register([first, make_cloud(moved)], np.array([0]), np.array([1]), np.array([[0.9, 0.0, 0.0]]))
    assert len(pair.first) == 1
    yaw, shift = pair.motion[0, 0], pair.motion[0, 1:]
    # The shift is that of the first cloud's centre, which is not the box's.
    expected = turned(pair.centre_m - centre, 0.04) + centre + (0.8, 0.1, 0.02) - pair.centre_m
    assert abs(yaw - 0.04) < 0.005
    assert np.abs(shift - expected).max() < 0.02


def test_clouds_that_do_not_meet_are_left_out() -> None:
    rng = np.random.default_rng(2)
    clouds = [make_cloud(box_surface(rng, 100) + far) for far in (0.0, 50.0)]
    assert len(register(clouds, np.array([0]), np.array([1]), np.zeros((1, 3))).first) == 0


def circle_pairs(time: np.ndarray, arm_m: np.ndarray) -> tuple[np.ndarray, PairMotions]:
    """True poses on a bend, and exact motions between neighbours about a place `arm_m` off the origin."""
    yaw = 0.05 * time
    pose = np.column_stack([20 * np.sin(yaw), 20 - 20 * np.cos(yaw), 0.01 * time, yaw])
    i = np.arange(len(time) - 1)
    place = [pose[k, :3] + turned(arm_m, pose[k, 3]) for k in range(len(time))]
    motion = np.array([[yaw[k + 1] - yaw[k], *(place[k + 1] - place[k])] for k in i])
    information = np.tile(np.diag([1e5, 1e4, 1e4, 1e4]), (len(i), 1, 1))
    return pose, PairMotions(
        i, i + 1, np.array(place[:-1]), motion, information, np.ones(len(i)), np.zeros(len(i))
    )


def test_smoothing_keeps_exact_motions_with_gaps_in_time() -> None:
    time = np.array([0.0, 1.0, 2.0, 4.0, 5.0, 6.0, 7.5])
    truth, pairs = circle_pairs(time, np.array([1.0, 0.5, 0.2]))
    rng = np.random.default_rng(3)
    start = truth + rng.normal(0, 0.1, truth.shape) * (1, 1, 1, 0.1)
    found = smooth_poses(start, time, pairs)
    # The frame's own place in the object is free: compare how places of the object move.
    for k in range(len(time) - 1):
        for at in (np.zeros(3), np.array([2.0, 1.0, 0.0])):
            in_truth = turned(at - truth[k, :3] + truth[k, :3], 0.0)
            before = found[k, :3] + turned(in_truth, found[k, 3])
            in_true_frame = turned(before - truth[k, :3], -truth[k, 3])
            after_truth = truth[k + 1, :3] + turned(in_true_frame, truth[k + 1, 3])
            after = found[k + 1, :3] + turned(in_truth, found[k + 1, 3])
            assert np.linalg.norm(after - after_truth) < 0.02


def test_one_wild_registration_is_outvoted() -> None:
    time = np.arange(8.0)
    truth, pairs = circle_pairs(time, np.zeros(3))
    pairs.motion[3, 1:] += (0.9, -0.9, 0.0)
    found = smooth_poses(truth.copy(), time, pairs)
    assert np.linalg.norm(np.diff(found[:, :3] - truth[:, :3], axis=0), axis=1).max() < 0.05


def an_object() -> MovingObject:
    pose = np.array([[0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.1], [3.0, 0.0, 0.0, 0.1]])
    return MovingObject(
        np.array([0, 1, 3], np.int32), np.array([0.0, 0.1, 0.3]), pose, 0.1, -np.ones(3), np.ones(3)
    )


def test_poses_are_linear_between_scans_and_go_on_beyond() -> None:
    found = an_object().pose_at(np.array([0.05, 0.2, -0.1, 0.4]))
    assert np.allclose(found, [[0.5, 0, 0, 0.05], [2.0, 0, 0, 0.1], [-1.0, 0, 0, -0.1], [4.0, 0, 0, 0.1]])


def test_an_object_is_there_for_one_and_a_half_frames_beyond_its_scans() -> None:
    assert an_object().is_there(np.array([-0.16, -0.14, 0.2, 0.44, 0.46])).tolist() == [
        False, True, True, True, False,
    ]  # fmt: skip


def test_the_objects_frame_goes_along_with_it() -> None:
    moving = an_object()
    time_s = np.array([0.03, 0.17, 0.31])
    pose = moving.matrix_at(time_s)
    place = np.array([0.4, -0.2, 0.3])
    there = pose[:, :3, :3] @ place + pose[:, :3, 3]
    assert np.allclose(moving.to_object(there, time_s), place)
