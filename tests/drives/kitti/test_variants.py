"""KITTI's trees as others hand them on: with SemanticKITTI's poses, with images as JPEG."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from nvsf_core.demo.drive import DemoSize, write_demo
from nvsf_core.drives.drive import AbstractDrive, drive_of
from nvsf_core.errors import CalibrationError
from nvsf_core.stages.exports.kitti import write_kitti
from tests.drives.copies import data_set, lidar_path, scene_at, tiny_scene
from tests.drives.kitti.raw_writer import write_raw


@pytest.fixture(scope="module")
def demo(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("demo")
    write_demo(folder, size=DemoSize.tiny())
    return folder


def _odometry(demo: Path, folder: Path) -> AbstractDrive:
    write_kitti(folder, data_set(tiny_scene(demo)))
    return drive_of(scene_at(folder / "kitti", "kitti_odometry", "00"))


def test_semantic_kittis_poses_are_read_where_the_benchmarks_are_not_there(demo, tmp_path):
    path = lidar_path(_odometry(demo, tmp_path))
    given, own = tmp_path / "kitti/poses/00.txt", tmp_path / "kitti/sequences/00/poses.txt"
    shutil.copy(given, own)
    given.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 4)
    drive = drive_of(scene_at(tmp_path / "kitti", "kitti_odometry", "00"))
    assert drive.facts().poses_place == given and own not in drive.section().files
    given.unlink()
    drive = drive_of(scene_at(tmp_path / "kitti", "kitti_odometry", "00"))
    assert drive.facts().poses_place == own and own in drive.section().files
    assert np.array_equal(lidar_path(drive), path)


def _as_jpeg(path: Path) -> np.ndarray:
    """Make a PNG a JPEG; returns what that shows, red first."""
    made = path.with_suffix(".jpg")
    cv2.imwrite(str(made), cv2.imread(str(path)))
    path.unlink()
    return cv2.imread(str(made))[:, :, ::-1]


@pytest.mark.parametrize("kind", ["kitti_odometry", "kitti_raw"])
def test_images_that_were_made_jpeg_are_read(demo, tmp_path, kind):
    if kind == "kitti_odometry":
        scene = _odometry(demo, tmp_path).scene
    else:
        scene = scene_at(tmp_path, kind, write_raw(tmp_path, data_set(tiny_scene(demo))))
    there = drive_of(scene).camera_place("image_02")
    kept, *others = sorted(there.iterdir())
    # Beside the original a copy is not looked at.
    kept.with_suffix(".jpg").write_bytes(b"no image")
    recorded = {int(path.stem): _as_jpeg(path) for path in others}
    drive = drive_of(scene)
    model = drive.calibration().cameras["image_02"].intrinsics
    for frame, rgb in recorded.items():
        found = drive.read_image("image_02", frame, model.width, model.height)
        assert np.array_equal(found, rgb)
        assert there / f"{sorted(others)[frame - 1].stem}.jpg" in drive.section().files
    assert drive.read_image("image_02", 0, model.width, model.height).shape == (model.height, model.width, 3)


def test_an_image_that_is_none_is_refused_by_name(demo, tmp_path):
    drive = _odometry(demo, tmp_path)
    for path in sorted(drive.camera_place("image_02").iterdir()):
        path.rename(path.with_suffix(".jpg"))
        path.with_suffix(".jpg").write_bytes(b"\xff\xd8 and no more")
    with pytest.raises(CalibrationError, match=r"000000\.jpg: expected a PNG or JPEG"):
        drive_of(drive.scene).facts()
