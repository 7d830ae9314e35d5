"""What moves in a bag, where several topics say so, or one repeats what is fixed."""

from pathlib import Path

import numpy as np
import pytest

from nvsf_core.drives.bags.transforms import TransformTree


def at(x_m: float) -> np.ndarray:
    pose = np.eye(4)
    pose[0, 3] = x_m
    return pose


def tree(*links: tuple[str, str, float, float | None, str]) -> TransformTree:
    """Links as (child, parent, x in m, seconds, topic)."""
    found = TransformTree(Path("bag"))
    for child, parent, x_m, time_s, topic in links:
        found.add(child, parent, at(x_m), time_s, topic)
    found.settle()
    return found


def path_x_m(found: TransformTree, frame: str) -> list[float]:
    path = found.path(frame)
    assert path is not None
    return [round(float(x_m), 6) for x_m in path.poses[:, 0, 3]]


def test_transforms_come_before_an_odometry_that_says_otherwise() -> None:
    links = [("base", "odom", 0.1 * k, 0.1 * k, "/tf") for k in range(4)]
    links += [("base", "odom", 3.0 + 0.1 * k, 0.05 + 0.1 * k, "/wheel_odom") for k in range(9)]
    assert path_x_m(tree(*links), "base") == [0.0, 0.1, 0.2, 0.3]


def test_of_two_odometries_the_one_with_more_poses_is_the_path() -> None:
    links = [("base", "odom", 1.0 + k, 0.1 * k, "/a") for k in range(3)]
    links += [("base", "odom", 5.0 + k, 0.05 * k, "/b") for k in range(5)]
    assert path_x_m(tree(*links), "base") == [5.0, 6.0, 7.0, 8.0, 9.0]


def test_what_is_repeated_without_change_is_a_mounting_and_no_path() -> None:
    found = tree(*[("lidar", "base", 1.5, 0.1 * k, "/tf") for k in range(4)])
    assert found.path("lidar") is None
    mounting = found.between("lidar", "base")
    assert mounting is not None and mounting[0, 3] == 1.5


def test_a_car_that_stands_has_a_path() -> None:
    found = tree(*[("base", "odom", 2.0, 0.1 * k, "/tf") for k in range(3)])
    assert path_x_m(found, "base") == [2.0, 2.0, 2.0]


def test_a_slow_car_far_from_its_maps_origin_has_a_path() -> None:
    found = tree(*[("base", "local", 5e5 + 0.1 * k, 0.1 * k, "/tf") for k in range(3)])
    assert path_x_m(found, "base") == [500_000.0, 500_000.1, 500_000.2]


def test_a_mounted_lidar_whose_odometry_names_it_keeps_its_cameras() -> None:
    links: list[tuple[str, str, float, float | None, str]] = [
        ("lidar", "base_link", 1.0, None, "/tf_static"), ("camera", "base_link", 1.5, None, "/tf_static"),
    ]  # fmt: skip
    links += [("lidar", "odom_lidar", 0.5 * k, 0.1 * k, "/kiss/odometry") for k in range(3)]
    found = tree(*links)
    mounting = found.between("camera", "lidar")
    assert mounting is not None and mounting[0, 3] == 0.5
    assert path_x_m(found, "lidar") == [0.0, 0.5, 1.0]
    assert found.notes_on("lidar") == []
    (note,) = tree(*links, ("base_link", "odom", 0.0, 0.0, "/tf")).notes_on("lidar")
    assert "is mounted on base_link, which moves, too" in note


@pytest.mark.parametrize("is_wheel_first", [True, False])
def test_a_localised_car_does_not_follow_its_wheels_whatever_came_first(is_wheel_first: bool) -> None:
    localised: list[tuple[str, str, float, float | None, str]]
    localised = [("base", "map", 0.1 * k, 0.1 * k, "/tf") for k in range(3)]
    wheel = [("base", "odom", 3.0 + k, 0.01 * k, "/wheel") for k in range(9)]
    found = tree(*(wheel + localised if is_wheel_first else localised + wheel))
    assert path_x_m(found, "base") == [0.0, 0.1, 0.2]
    assert found.notes_on("base") == [
        "base moves as /tf says, in map (3 poses); not used: /wheel says, in odom (9 poses)"
    ]
