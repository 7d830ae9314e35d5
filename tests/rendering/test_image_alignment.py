"""Laws of aligned images, on photographs of a room's corner from poses that were told slightly wrong."""

import tracemalloc

import numpy as np
import pytest

from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.geometry.se3 import exp_se3, invert_pose
from nvsf_core.rendering.image_alignment import PoseCorrection, align_images
from tests.rendering.corner import CAMERA, COUNT, RGB, SEEN, TIME_S, TRUE


def _told(errors: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """Poses with errors, and the returns as such poses place them: both sensors sit on one vehicle."""
    told = TRUE @ exp_se3(errors)
    moved = told @ invert_pose(TRUE)
    points = [point[1::3, 1::3].reshape(-1, 3) for point, _ in SEEN]
    return told, [p @ m[:3, :3].T + m[:3, 3] for p, m in zip(points, moved, strict=True)]


def _apart_px(pose: np.ndarray) -> float:
    """How far neighbouring images' pictures of a point lie from where they truly are, RMS."""
    squares = []
    for j in range(COUNT - 1):
        point = SEEN[j][0][1::3, 1::3].reshape(-1, 3) @ TRUE[j, :3, :3] - TRUE[j, :3, 3] @ TRUE[j, :3, :3]
        found = []
        for poses in (TRUE, pose):
            motion = invert_pose(poses[j + 1]) @ poses[j]
            there = point @ motion[:3, :3].T + motion[:3, 3]
            found.append(CAMERA.fx * there[:, :2] / there[:, 2:])
        squares.append(np.square(found[1] - found[0]).sum(axis=1).mean())
    return float(np.sqrt(np.mean(squares)))


def test_images_that_were_told_wrong_poses_come_to_lie_where_they_are() -> None:
    scale = np.array([0.01, 0.01, 0.01, 0.002, 0.002, 0.002])
    told, returns_m = _told(np.random.default_rng(0).normal(size=(COUNT, 6)) * scale)
    twist = align_images(RGB, CAMERA, told, returns_m)
    assert _apart_px(told) > 0.4
    assert _apart_px(told @ exp_se3(twist)) < 0.25 * _apart_px(told)


def test_images_that_were_told_their_poses_stay() -> None:
    told, returns_m = _told(np.zeros((COUNT, 6)))
    assert _apart_px(told @ exp_se3(align_images(RGB, CAMERA, told, returns_m))) < 0.05


def test_without_returns_or_a_neighbour_nothing_is_corrected() -> None:
    nothing = [np.zeros((0, 3), np.float32)] * COUNT
    assert not align_images(RGB, CAMERA, TRUE, nothing).any()
    assert not align_images(RGB[:1], CAMERA, TRUE[:1], [SEEN[0][0].reshape(-1, 3)]).any()


def test_a_view_between_images_is_corrected_as_they_are_and_a_left_out_one_says_nothing() -> None:
    drifting = np.linspace(0.001, 0.002, COUNT)[:, None] * np.ones(6)
    correction = PoseCorrection(TIME_S, drifting)
    expected = exp_se3(np.full(6, 0.0015))
    assert correction.at(np.eye(4), 0.25) == pytest.approx(expected, abs=1e-6)
    for time_s, index in ((-5.0, 0), (5.0, -1)):
        assert correction.at(np.eye(4), time_s) == pytest.approx(exp_se3(drifting[index]), abs=2e-4)
    wrong = drifting.copy()
    wrong[2] = 0.5
    left_out = PoseCorrection(TIME_S, wrong).at(np.eye(4), float(TIME_S[2]), leave_out=True)
    assert left_out == pytest.approx(exp_se3(drifting[2]), abs=1e-4)
    alone = PoseCorrection(TIME_S[:1], drifting[:1])
    assert alone.at(np.eye(4), 3.0) == pytest.approx(exp_se3(drifting[0]))
    assert alone.at(np.eye(4), 0.0, leave_out=True) == pytest.approx(exp_se3(drifting[0]))
    assert correction.of_images(TRUE, TIME_S) == pytest.approx(TRUE @ exp_se3(drifting))


def test_images_that_were_not_aligned_go_with_those_around_them_and_say_nothing() -> None:
    drifting = np.linspace(0.001, 0.002, COUNT)[:, None] * np.ones(6)
    heard = np.array([0, 1, 3, 5])
    some = PoseCorrection(TIME_S[heard], drifting[heard])
    assert some.of_images(TRUE, TIME_S) == pytest.approx(TRUE @ exp_se3(drifting), abs=1e-4)
    assert np.array_equal(some.of_images(TRUE, TIME_S)[heard], TRUE[heard] @ exp_se3(drifting[heard]))
    for silent in (2, 4):
        alike = [some.at(TRUE[silent], float(TIME_S[silent]), leave_out=out) for out in (False, True)]
        assert np.array_equal(*alike)
        assert np.array_equal(some.of_images(TRUE, TIME_S)[silent], alike[0])


def test_the_memory_of_aligning_grows_with_images_and_not_with_their_square() -> None:
    count = 300
    pinhole = Pinhole(fx=10.0, fy=10.0, cx=11.5, cy=9.5, width=24, height=20)
    pose = np.tile(np.eye(4), (count, 1, 1))
    pose[:, 2, 3] = np.arange(count)
    nothing = [np.zeros((0, 3), np.float32)] * count
    tracemalloc.start()
    align_images([np.zeros((20, 24, 3), np.uint8)] * count, pinhole, pose, nothing)
    most_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most_bytes < 8 * (6 * count) ** 2
