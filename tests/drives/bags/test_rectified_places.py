"""Where the cameras of rectified images stand: `R` and the fourth column of `P`, and frames of their own."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nvsf_core.drives.detect import whole_drive
from nvsf_core.drives.drive import drive_of
from nvsf_core.drives.kitti360.calibration import Calibration
from nvsf_core.errors import CalibrationError
from nvsf_core.geometry.se3 import exp_so3, pose_from_parts
from tests.drives.bags.small_bag import camera, link, moving_lidar, new, write_bag

LENS = (60.0, 60.0, 33.0, 25.0)
BASELINE_M = 0.12
LEFT_RAD, RIGHT_RAD = np.array([0.01, 0.02, -0.005]), np.array([-0.015, 0.004, 0.01])


def rectified(
    topic: str, frame: str, right_of_first_m: float = 0.0, turn_rad: np.ndarray | None = None
) -> list[tuple[str, Any, float]]:
    """A camera info, and an image on `<topic>`, of a camera of a stereo pair."""
    info, image = camera(1.0, LENS, (0.0,) * 5, LENS)
    p = info.p.copy()
    p[3] = -LENS[0] * right_of_first_m
    r = np.eye(3) if turn_rad is None else exp_so3(turn_rad)
    info = replace(info, header=replace(info.header, frame_id=frame), p=p, r=r.ravel())
    image = replace(image, header=replace(image.header, frame_id=frame))
    return [(f"{topic.rpartition('/')[0]}/camera_info", info, 1.0), (topic, image, 1.0)]


def mounted(parent: str, child: str, x_m: float, turn: np.ndarray) -> tuple[str, Any, float]:
    message = link(0.0, parent, child, x_m)
    (one,) = message.transforms
    x, y, z, w = Rotation.from_matrix(turn).as_quat()
    moved = replace(one.transform, rotation=new("Quaternion", x=x, y=y, z=z, w=w))
    return "/tf_static", replace(message, transforms=[replace(one, transform=moved)]), 0.0


def calibration(folder: Path, messages: Sequence[tuple[str, Any, float]]) -> Calibration:
    write_bag(folder, [*moving_lidar(), *messages])
    return drive_of(whole_drive(folder, "bag")).facts().calibration


def to_cam(found: Calibration, name: str) -> np.ndarray:
    """Pose (4, 4) of a camera in the frame `cam`, which lies 0.5 m before the LiDAR."""
    pose = found.cameras[name].to_pose.copy()
    pose[0, 3] -= 0.5
    return pose


def test_rectified_raw_images_find_the_camera_info_beside_them(tmp_path: Path) -> None:
    found = calibration(tmp_path / "bag", rectified("/camera/infra1/image_rect_raw", "cam"))
    assert list(found.cameras) == ["camera_infra1"] and found.notes == ()
    assert np.allclose(to_cam(found, "camera_infra1"), np.eye(4))


def test_images_of_depth_are_left_out_by_their_encoding(tmp_path: Path) -> None:
    info, (topic, image, _) = rectified("/camera/depth/image_rect_raw", "cam")
    deep = (topic, replace(image, encoding="16UC1"), 1.0)
    found = calibration(tmp_path / "bag", [info, deep])
    assert not found.cameras
    (note,) = found.notes
    assert "camera_depth left out" in note and "encoding" in note and "'16UC1'" in note


def test_a_right_camera_of_the_first_ones_frame_stands_where_p_says(tmp_path: Path) -> None:
    pair = [*rectified("/left/image_rect", "cam"), *rectified("/right/image_rect", "cam", BASELINE_M)]
    found = calibration(tmp_path / "bag", pair)
    assert np.allclose(to_cam(found, "left"), np.eye(4))
    assert np.allclose(to_cam(found, "right"), pose_from_parts(np.eye(3), np.array([BASELINE_M, 0.0, 0.0])))
    (note,) = found.notes
    assert "right: stands 0.120 m and 0.00 degrees from 'cam'" in note


def test_a_rectified_pair_of_one_frame_is_turned_by_the_first_ones_r(tmp_path: Path) -> None:
    left = rectified("/left/image_rect", "cam", turn_rad=LEFT_RAD)
    right = rectified("/right/image_rect", "cam", BASELINE_M, RIGHT_RAD)
    found = calibration(tmp_path / "bag", [*left, *right])
    turn = exp_so3(LEFT_RAD).T
    assert np.allclose(to_cam(found, "left")[:3, :3], turn, atol=1e-9)
    assert np.allclose(to_cam(found, "right")[:3, :3], turn, atol=1e-9)
    assert np.allclose(to_cam(found, "right")[:3, 3], turn @ [BASELINE_M, 0.0, 0.0], atol=1e-9)


def test_frames_of_the_cameras_as_built_are_turned_and_not_moved(tmp_path: Path) -> None:
    # R turns each from its frame to the rectified axes, those of `cam`.
    built = [
        mounted("cam", "left_built", 0.0, exp_so3(LEFT_RAD)),
        mounted("cam", "right_built", BASELINE_M, exp_so3(RIGHT_RAD)),
    ]
    left = rectified("/left/image_rect", "left_built", turn_rad=LEFT_RAD)
    right = rectified("/right/image_rect", "right_built", BASELINE_M, RIGHT_RAD)
    found = calibration(tmp_path / "bag", [*built, *left, *right])
    assert np.allclose(to_cam(found, "left"), np.eye(4), atol=1e-9)
    place = pose_from_parts(np.eye(3), np.array([BASELINE_M, 0.0, 0.0]))
    assert np.allclose(to_cam(found, "right"), place, atol=1e-9)


@pytest.mark.parametrize("has_left", [True, False])
def test_frames_of_the_rectified_cameras_are_taken_as_they_are(tmp_path: Path, has_left: bool) -> None:
    # As kitti2bag and RealSense write them: R and P stand in the fixed transforms already.
    frames = [mounted("cam", name, x_m, np.eye(3)) for name, x_m in (("l", 0.0), ("r", BASELINE_M))]
    left = rectified("/left/image_rect", "l", turn_rad=LEFT_RAD) if has_left else []
    right = rectified("/right/image_rect", "r", BASELINE_M, RIGHT_RAD)
    found = calibration(tmp_path / "bag", [*frames, *left, *right])
    place = pose_from_parts(np.eye(3), np.array([BASELINE_M, 0.0, 0.0]))
    assert np.allclose(to_cam(found, "right"), place, atol=1e-9) and found.notes == ()
    assert not has_left or np.allclose(to_cam(found, "left"), np.eye(4), atol=1e-9)


def test_raw_images_are_neither_turned_nor_moved(tmp_path: Path) -> None:
    found = calibration(tmp_path / "bag", rectified("/right/image_raw", "cam", BASELINE_M, RIGHT_RAD))
    assert np.allclose(to_cam(found, "right"), np.eye(4))


def test_an_impossible_rectification_is_refused(tmp_path: Path) -> None:
    info, image = rectified("/left/image_rect", "cam")
    turned = (info[0], replace(info[1], r=2.0 * np.eye(3).ravel()), 1.0)
    (note,) = calibration(tmp_path / "a", [turned, image]).notes
    assert "left left out" in note and "R: expected a rotation" in note
    far = rectified("/right/image_rect", "cam", 100.0)
    write_bag(tmp_path / "b", [*moving_lidar(), *far])
    scene = replace(whole_drive(tmp_path / "b", "bag"), cameras=("right",))
    with pytest.raises(CalibrationError, match="P: expected a second camera within 10 m of the first"):
        drive_of(scene).facts()
