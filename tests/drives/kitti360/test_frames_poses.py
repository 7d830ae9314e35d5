from pathlib import Path

import numpy as np
import pytest

from nvsf_core.drives.kitti360.frames import compare_poses, read_cam0_to_world, read_poses
from nvsf_core.errors import DataError

LINE = "{} 1 0 0 {} 0 1 0 3700.5 0 0 1 115"


def written(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(lines) + "\n")
    return path


def test_poses_are_found_by_frame_number_in_float64(tmp_path: Path) -> None:
    path = written(tmp_path / "poses.txt", LINE.format(7, "1000.000000001"), "", LINE.format("9.0e0", 2000))
    poses = read_poses(path)
    assert sorted(poses) == [7, 9]
    assert poses[7][0, 3] == 1000.000000001 and poses[7].dtype == np.float64


def test_a_frame_without_a_line_has_no_pose(tmp_path: Path) -> None:
    poses = read_poses(written(tmp_path / "poses.txt", LINE.format(1, 0), LINE.format(3, 0)))
    assert 2 not in poses


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        ("8 1 0 0", "expected 13 numbers, found 4"),
        ("8 1 0 0 zero 0 1 0 0 0 0 1 0", "could not convert"),
        ("8 1 0 0 nan 0 1 0 0 0 0 1 0", "finite"),
        ("8 3 0 0 0 0 1 0 0 0 0 1 0", "expected a rotation"),
        ("8.5 1 0 0 0 0 1 0 0 0 0 1 0", "expected a frame number"),
        ("7 1 0 0 0 0 1 0 0 0 0 1 0", "frame 7 has a pose already"),
    ],
)
def test_a_bad_line_names_file_line_and_remedy(tmp_path: Path, bad: str, reason: str) -> None:
    path = written(tmp_path / "poses.txt", LINE.format(7, 0), bad)
    with pytest.raises(DataError, match=rf"poses\.txt, line 2: .*{reason}.*delete the line"):
        read_poses(path)


def test_an_absent_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"cannot read poses .*poses\.txt"):
        read_poses(tmp_path / "poses.txt")


def test_camera_poses_are_whole_matrices(tmp_path: Path) -> None:
    path = written(tmp_path / "cam0_to_world.txt", LINE.format(7, 1000) + " 0 0 0 1")
    assert np.array_equal(read_cam0_to_world(path)[7][:3, 3], [1000, 3700.5, 115])


def test_disagreement_is_the_largest_distance_and_angle() -> None:
    turned = np.eye(4)
    angle_rad = np.radians(0.001)
    turned[:2, :2] = [[np.cos(angle_rad), -np.sin(angle_rad)], [np.sin(angle_rad), np.cos(angle_rad)]]
    moved = np.eye(4)
    moved[2, 3] = 0.25
    gap = compare_poses({1: np.eye(4), 2: np.eye(4), 3: np.eye(4)}, {1: turned, 2: moved})
    assert gap.frames == 2
    assert gap.translation_m == pytest.approx(0.25)
    assert gap.rotation_deg == pytest.approx(0.001, rel=1e-6)
