"""Images that are rectified already, on topics whose name does not say so, are of P's camera."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nvsf_core.drives.detect import whole_drive
from nvsf_core.drives.drive import AbstractDrive, drive_of
from nvsf_core.drives.entries import SceneEntry
from nvsf_core.errors import CalibrationError
from tests.drives.bags.small_bag import HEIGHT, WIDTH, camera, moving_lidar, write_bag

NAME, TOPIC = "kitti_camera_color_left", "/kitti/camera_color_left/image"
RAW, LENS, RECTIFIED = (60.0, 60.0, 33.0, 25.0), (-0.3, 0.1, 0.0, 0.0, 0.0), (45.0, 45.0, 31.0, 23.0)
NOTHING = (0.0,) * 4


def _scene(folder: Path, k: tuple[float, ...] = RAW, p: tuple[float, ...] = RECTIFIED) -> SceneEntry:
    info, image = camera(1.0, k, LENS, p)
    messages = [(TOPIC.replace("image", "camera_info"), info, 1.0), (TOPIC, image, 1.0)]
    write_bag(folder, [*moving_lidar(), *messages])
    return whole_drive(folder, "bag")


def _camera_px(drive: AbstractDrive) -> tuple[float, ...]:
    found = drive.facts().calibration.cameras[NAME].intrinsics
    return (found.fx, found.fy, found.cx, found.cy)


def _is_as_recorded(drive: AbstractDrive) -> bool:
    return np.array_equal(drive.read_image(NAME, 0, WIDTH, HEIGHT), _recorded())


def _recorded() -> np.ndarray:
    return np.asarray(camera(1.0, RAW, LENS, RECTIFIED)[1].data).reshape(HEIGHT, WIDTH, 3)


def test_a_scene_says_which_cameras_are_rectified_and_a_note_says_where_to(tmp_path: Path) -> None:
    scene = _scene(tmp_path / "bag")
    (note,) = drive_of(scene).facts().calibration.notes
    assert TOPIC in note and f"rectified = ['{NAME}']" in note
    assert not _is_as_recorded(drive_of(scene))
    said = drive_of(replace(scene, rectified=(NAME,)))
    assert _camera_px(said) == RECTIFIED and _is_as_recorded(said)
    assert said.facts().calibration.notes == ()
    bare = replace(_scene(tmp_path / "bare", p=NOTHING), rectified=(NAME,))
    assert _camera_px(drive_of(bare)) == RAW and _is_as_recorded(drive_of(bare))


def test_a_camera_that_is_not_there_is_not_rectified(tmp_path: Path) -> None:
    scene = _scene(tmp_path / "bag")
    with pytest.raises(CalibrationError, match=r"rectified: no images of camera left; there are \['kitti"):
        drive_of(replace(scene, rectified=("left",))).facts()


def test_a_camera_info_without_k_is_read_by_its_p(tmp_path: Path) -> None:
    drive = drive_of(_scene(tmp_path / "bag", NOTHING))
    assert _camera_px(drive) == RECTIFIED and _is_as_recorded(drive)


def test_like_cameras_of_k_and_p_raise_no_doubt(tmp_path: Path) -> None:
    assert drive_of(_scene(tmp_path / "bag", p=RAW)).facts().calibration.notes == ()
