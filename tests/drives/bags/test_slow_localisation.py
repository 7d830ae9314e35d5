"""Poses between the messages of a slow localisation, and what is said where they are too far apart."""

from pathlib import Path

import numpy as np
import pytest

from nvsf_core.drives.detect import whole_drive
from nvsf_core.drives.drive import DriveFacts, drive_of
from nvsf_core.errors import DataError
from tests.drives.bags.small_bag import cloud, link, write_bag

START_S = 1_600_000_000.0
SPEED_M_S = 5.0


def facts(folder: Path, pose_times_s: list[float], scans: int = 30) -> DriveFacts:
    """Of a car with 10 scans a second, whose place is told at some times."""
    moments_s = [START_S + 0.1 * k for k in range(scans)]
    messages = [("/points", cloud(one, "lidar", ["x", "y", "z", "ring"]), one) for one in moments_s]
    messages += [
        ("/tf", link(START_S + one, "map", "lidar", SPEED_M_S * one), START_S + one) for one in pose_times_s
    ]
    write_bag(folder, messages)
    return drive_of(whole_drive(folder, "bag")).facts()


def test_a_localisation_of_1_hz_that_is_not_quite_even_places_every_scan(tmp_path: Path) -> None:
    found = facts(tmp_path / "bag", [-0.02, 1.03, 1.98, 3.01])
    assert sorted(found.poses) == list(range(30))
    for frame, pose in found.poses.items():
        assert abs(pose[0, 3] - SPEED_M_S * 0.1 * frame) < 1e-4
    assert not any("no pose" in note for note in found.notes)


def test_scans_between_poses_too_far_apart_are_counted_with_the_gap(tmp_path: Path) -> None:
    found = facts(tmp_path / "bag", [0.0, 0.5, 1.0, 2.9])
    assert sorted(found.poses) == [*range(11), 29]
    (note,) = [note for note in found.notes if "no pose" in note]
    assert "18 of 30 frames have no pose" in note and "at most 1.5 s apart" in note
    assert "has 4 from" in note and "0.5 s apart in the median, at most 1.9 s" in note


def test_poses_all_too_far_apart_are_refused_with_their_rate(tmp_path: Path) -> None:
    with pytest.raises(
        DataError, match=r"30 of 30 frames have no pose.*3 s apart in the median.*higher rate"
    ):
        facts(tmp_path / "bag", [-0.55, 2.45, 5.45])


def test_links_that_are_never_known_together_are_refused_by_name(tmp_path: Path) -> None:
    messages = [("/points", cloud(1.0 + 0.1 * k, "lidar", ["x", "y", "z", "ring"]), 1.0) for k in range(3)]
    messages += [("/tf", link(0.1 * k, "odom", "lidar", 0.5 * k), 0.1 * k) for k in range(9)]
    messages += [("/tf", link(50.0 + k, "map", "odom", 0.1 * k), 50.0) for k in range(2)]
    write_bag(tmp_path / "bag", messages)
    with pytest.raises(
        DataError, match=r"lidar in odom: 9 poses from 0.000 to 0.800 s, 0.1 s apart.*odom in map"
    ):
        drive_of(whole_drive(tmp_path / "bag", "bag")).facts()


def test_a_map_in_which_the_odometry_never_moves_is_fixed(tmp_path: Path) -> None:
    messages = [("/points", cloud(1.0 + 0.1 * k, "lidar", ["x", "y", "z", "ring"]), 1.0) for k in range(3)]
    messages += [("/tf", link(1.0 + 0.1 * k, "odom", "lidar", 0.5 * k), 1.0) for k in range(3)]
    messages.append(("/tf", link(0.0, "map", "odom", 100.0), 0.0))
    write_bag(tmp_path / "bag", messages)
    found = drive_of(whole_drive(tmp_path / "bag", "bag")).facts().poses
    assert np.allclose([pose[0, 3] for pose in found.values()], [100.0, 100.5, 101.0])
