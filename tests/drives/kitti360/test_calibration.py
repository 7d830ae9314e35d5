from pathlib import Path

import numpy as np
import pytest

from nvsf_core.drives.kitti360.calibration import (
    CameraCalibration,
    read_calibration,
    read_mei,
    read_pinhole,
)
from nvsf_core.drives.kitti360.layout import DriveLayout
from nvsf_core.drives.kitti360.text import KeyedText, parse_numbers
from nvsf_core.errors import CalibrationError
from nvsf_core.geometry.fisheye import MeiFisheye
from nvsf_core.geometry.pinhole import Pinhole
from tests.conftest import SHARED

SEQUENCE = "2013_05_28_drive_9900_sync"
REAL = SHARED / "data"

PERSPECTIVE = """\
S_rect_00: 64.000000 48.000000
R_rect_00: 0.0 -1.0 0.0 1.0 0.0 0.0 0.0 0.0 1.0
P_rect_00: 50.0 0.0 31.5 0.0 0.0 51.0 23.5 0.0 0.0 0.0 1.0 0.0
"""
CAM_TO_POSE = "image_00: 0 0 1 1.5 1 0 0 0.25 0 1 0 -0.5\n"
CAM_TO_VELO = "0 0 1 0.5 -1 0 0 0.25 0 -1 0 -0.25\n"


def calibrated(root: Path, **changed: str) -> DriveLayout:
    folder = root / "calibration"
    folder.mkdir(parents=True)
    files = {"perspective": PERSPECTIVE, "calib_cam_to_pose": CAM_TO_POSE, "calib_cam_to_velo": CAM_TO_VELO}
    for name, text in (files | changed).items():
        if text:
            (folder / f"{name}.txt").write_text(text)
    layout = DriveLayout(root, SEQUENCE)
    layout.camera_dir("image_00").mkdir(parents=True)
    return layout


def test_a_point_goes_through_lidar_camera_and_pose_frame_alike(tmp_path: Path) -> None:
    calibration = read_calibration(calibrated(tmp_path), None, has_scans=True)
    # A point 2 m before the unrectified camera: the files' matrices, applied by hand.
    in_velo = np.array([0.5 + 2.0, 0.25, -0.25, 1.0])
    in_pose = np.array([1.5 + 2.0, 0.25, -0.5, 1.0])
    assert np.allclose(calibration.lidar_to_pose @ in_velo, in_pose)
    # The rectified camera is the unrectified one turned by R_rect: the optical axis stays here.
    assert np.allclose(calibration.cameras["image_00"].to_pose @ [0.0, 0.0, 2.0, 1.0], in_pose)
    # Its x axis is what R_rect makes of the unrectified camera's: x_rect = R x, so x = R^T x_rect.
    assert np.allclose(calibration.cameras["image_00"].to_pose[:3, 0], [0.0, 0.0, -1.0])


def test_intrinsics_come_from_the_rectified_projection(tmp_path: Path) -> None:
    layout = calibrated(tmp_path)
    expected = Pinhole(width=64, height=48, fx=50.0, fy=51.0, cx=31.5, cy=23.5)
    assert read_pinhole(KeyedText.read(layout.perspective_path), "image_00") == expected


def test_a_missing_key_names_file_key_and_remedy(tmp_path: Path) -> None:
    layout = calibrated(tmp_path, perspective=PERSPECTIVE.replace("P_rect_00", "P_rect_07"))
    with pytest.raises(CalibrationError, match=r"perspective\.txt: key 'P_rect_00' is missing .*restore"):
        read_calibration(layout, None, has_scans=True)


def test_a_garbled_number_names_file_and_line(tmp_path: Path) -> None:
    layout = calibrated(tmp_path, perspective=PERSPECTIVE.replace("51.0", "fifty"))
    with pytest.raises(CalibrationError, match=r"perspective\.txt, line 3, P_rect_00"):
        read_calibration(layout, None, has_scans=True)


def test_a_mounting_that_is_no_rotation_is_refused(tmp_path: Path) -> None:
    layout = calibrated(tmp_path, calib_cam_to_velo="2 0 0 0 0 1 0 0 0 0 1 0\n")
    with pytest.raises(CalibrationError, match=r"calib_cam_to_velo\.txt, line 1: expected a rotation"):
        read_calibration(layout, None, has_scans=True)


def test_a_lidar_only_drive_needs_no_camera_calibration(tmp_path: Path) -> None:
    layout = calibrated(tmp_path, perspective="")
    layout.camera_dir("image_00").rmdir()
    calibration = read_calibration(layout, None, has_scans=True)
    assert calibration.cameras == {} and not calibration.lidar_is_assumed


def test_a_camera_only_drive_stands_a_lidar_at_the_pose_frame_turned_z_up(tmp_path: Path) -> None:
    calibration = read_calibration(calibrated(tmp_path, calib_cam_to_velo=""), None, has_scans=False)
    assert calibration.lidar_is_assumed
    assert np.array_equal(calibration.lidar_to_pose @ [1.0, 2.0, 3.0, 1.0], [1.0, -2.0, -3.0, 1.0])


def test_scans_without_a_lidar_mounting_are_an_error(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"calib_cam_to_velo\.txt"):
        read_calibration(calibrated(tmp_path, calib_cam_to_velo=""), None, has_scans=True)


def test_a_camera_without_calibration_is_left_out_unless_it_was_asked_for(tmp_path: Path) -> None:
    layout = calibrated(tmp_path)
    layout.camera_dir("image_02").mkdir(parents=True)
    calibration = read_calibration(layout, None, has_scans=True)
    assert list(calibration.cameras) == ["image_00"] and "image_02 left out" in calibration.notes[0]
    with pytest.raises(CalibrationError, match=r"image_02\.yaml"):
        read_calibration(layout, ("image_02",), has_scans=True)
    with pytest.raises(CalibrationError, match="image_03 was asked for"):
        read_calibration(layout, ("image_03",), has_scans=True)


def test_numbers_that_are_not_finite_are_refused() -> None:
    with pytest.raises(ValueError, match="finite"):
        parse_numbers("1 nan", 2)
    with pytest.raises(ValueError, match="expected 3 numbers, found 2"):
        parse_numbers("1 2", 3)


def test_the_real_fisheye_calibration_is_read_as_it_is_printed() -> None:
    path = REAL / "kitti360_fisheye_sample" / "image_02.yaml"
    if not path.is_file():
        pytest.skip(f"no real data at {REAL}")
    found = read_mei(path)
    assert isinstance(found, MeiFisheye)
    assert (found.width, found.height) == (1400, 1400)
    assert found.xi == 2.2134047507854890e00 and found.k2 == 1.6548773243373522e00
    assert found.p1 == 4.2223943394772046e-04 and found.gamma2 == 1.3357883350012958e03
    assert found.v0 == 7.0576498308221585e02


def test_the_real_lidar_sees_the_real_camera_before_it_and_level() -> None:
    root = REAL / "k360_street"
    if not root.is_dir():
        pytest.skip(f"no real data at {REAL}")
    layout = DriveLayout(root, "2013_05_28_drive_9001_sync")
    calibration = read_calibration(layout, None, has_scans=True)
    camera_to_lidar = np.linalg.inv(calibration.lidar_to_pose) @ calibration.cameras["image_00"].to_pose
    assert list(calibration.cameras) == ["image_00"]
    assert np.allclose(camera_to_lidar[:3, 3], [0.804, 0.299, -0.177], atol=1e-3)
    assert camera_to_lidar[0, 2] > 0.99


def test_a_camera_too_small_to_render_from_is_refused_in_any_format(tmp_path: Path) -> None:
    """64 x 1 pixels were trained on until the field diverged; all formats' readers make this calibration."""
    small = PERSPECTIVE.replace("48.000000", "1.000000").replace("23.5", "0.5")
    reason = "camera image_00: expected an image of at least 8 x 8 pixels, found 64 x 1; leave the camera out"
    with pytest.raises(CalibrationError, match=reason):
        read_calibration(calibrated(tmp_path, perspective=small), None, has_scans=True)
    with pytest.raises(CalibrationError, match=r"camera front: .* found 8 x 2"):
        CameraCalibration(name="front", intrinsics=Pinhole(8.0, 8.0, 3.5, 0.5, 8, 2), to_pose=np.eye(4))
