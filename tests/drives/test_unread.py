"""Scans and images under names that are not read are named: a sensor never disappears without a word."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from nvsf_core.demo.drive import DemoSize, write_demo
from nvsf_core.drives.detect import whole_drive
from nvsf_core.drives.drive import drive_of, why_no_data
from nvsf_core.drives.kitti360.layout import DriveLayout
from nvsf_core.drives.kitti360.scans import Scan
from nvsf_core.drives.plain.layout import PlainLayout
from nvsf_core.drives.plain.writer import (
    write_cameras,
    write_description,
    write_plain_image,
    write_plain_scan,
    write_poses,
)
from nvsf_core.drives.validation import read_drive
from nvsf_core.errors import DataError
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.stages.imports.convert import import_drive
from tests.drives.copies import FRAMES, scene_at, tiny_scene


@pytest.fixture
def layout(tmp_path: Path) -> PlainLayout:
    """A drive of scans and of one camera."""
    found = PlainLayout(tmp_path / "drive")
    write_description(found, "VLP-16")
    write_poses(found, range(FRAMES), [0.1 * k for k in range(FRAMES)], [np.eye(4)] * FRAMES)
    write_cameras(found, {"left": (Pinhole(50.0, 50.0, 32.0, 24.0, 64, 48), np.eye(4))})
    noise = np.random.default_rng(0)
    for frame in range(FRAMES):
        rows = np.column_stack([noise.normal(0.0, 9.0, (50, 3)), np.full(50, 0.5)]).astype(np.float32)
        write_plain_scan(found, frame, Scan(rows, 0))
        write_plain_image(found, "left", frame, noise.integers(0, 256, (48, 64, 3), np.uint8))
    return found


def _renamed(folder: Path, name: str) -> None:
    for path in sorted(folder.iterdir()):
        path.rename(folder / name.format(path.stem, path.suffix))


HARMED = {
    "names of other tools": (
        lambda at: _renamed(at.scans_dir, "scan_{}{}"),
        r"scans: expected files named by their frame, as 0000000123\.bin, found 4 of other names, as 'scan_0",
    ),
    "a kind that is not read": (lambda at: _renamed(at.scans_dir, "{}.npy"), "found 4 of other names"),
    "another folder": (
        lambda at: at.scans_dir.rename(at.root / "lidar"),
        r"lidar: found 4 files as 0000000000\.bin, and none in .*scans, where they are expected; move them",
    ),
    "a folder below": (
        lambda at: shutil.copytree(at.scans_dir, at.root / "velodyne/data") and shutil.rmtree(at.scans_dir),
        r"velodyne/data: found 4 files",
    ),
    "no folder": (
        lambda at: [path.rename(at.root / path.name) for path in sorted(at.scans_dir.iterdir())],
        r"drive: found 4 files as 0000000000\.bin, and none in .*scans",
    ),
    "images of other names": (
        lambda at: _renamed(at.images_dir("left"), "left-{}{}"),
        r"left: expected files named by their frame, as 0000000123\.png, found 4",
    ),
    "images without a folder": (
        lambda at: at.images_dir("left").rename(at.root / "left"), "left: found 4 files as 0000000000\\.png",
    ),
    "two scans of a frame": (
        lambda at: shutil.copy(at.scan_path(1), at.scan_path(1).with_name("1.bin")),
        r"expected one file of frame 1, found 0000000001\.bin and 1\.bin; remove one",
    ),
    "two images of a frame": (
        lambda at: shutil.copy(at.image_path("left", 2), at.image_path("left", 2).with_suffix(".jpg")),
        r"expected one file of frame 2, found 0000000002\.jpg and 0000000002\.png",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", HARMED)
def test_a_drive_whose_files_would_be_passed_over_is_refused(layout, tmp_path, case):
    harm, words = HARMED[case]
    harm(layout)
    with pytest.raises(DataError, match=words):
        read_drive(scene_at(layout.root, "plain"), lambda _: None)
    with pytest.raises(DataError, match=words):
        import_drive(whole_drive(layout.root, "plain"), tmp_path / "out", progress=lambda _: None)


def test_a_drive_of_scans_alone_says_why_none_is_read(layout):
    shutil.rmtree(layout.root / "images")
    layout.cameras_path.unlink()
    _renamed(layout.scans_dir, "scan_{}{}")
    with pytest.raises(DataError, match="found 4 of other names"):
        why_no_data(scene_at(layout.root, "plain"))
    with pytest.raises(DataError, match="found 4 of other names"):
        whole_drive(layout.root, "plain")


def test_frames_that_a_drive_has_not_are_told_from_an_absent_drive(layout):
    scene = scene_at(layout.root, "plain", first_frame=100, last_frame=109, test_frames=(102,))
    assert "found frames within 0 to 3; correct first_frame and last_frame" in why_no_data(scene)
    absent = why_no_data(scene_at(layout.root / "absent", "plain"))
    assert "found none; correct its root" in absent and "KITTI360" not in absent


def test_single_misnamed_files_and_folders_are_named_and_the_others_read(layout, tmp_path):
    layout.scan_path(3).rename(layout.scans_dir / "last.bin")
    (layout.root / "rings").mkdir()
    (layout.root / "box.csv").touch()
    (layout.root / "notes.txt").touch()
    drive = read_drive(scene_at(layout.root, "plain"), lambda _: None)
    assert [row.scan_valid for row in drive.frames] == [True, True, True, False]
    assert len(drive.unread) == 3, drive.unread
    assert "found 1 of other names, as 'last.bin'" in drive.unread[0]
    assert "box.csv is not read: expected the name boxes.csv" in drive.unread[1]
    assert "rings is not read: expected the name ring" in drive.unread[2]
    done = import_drive(scene_at(layout.root, "plain"), tmp_path / "out", progress=lambda _: None)
    assert done.left_out[:3] == drive.unread
    assert json.loads((tmp_path / "out/import.json").read_text())["left_out"][:3] == list(drive.unread)


def test_a_drive_of_images_alone_and_one_of_scans_alone_are_read(layout):
    images = shutil.copytree(layout.root, layout.root.parent / "images_alone")
    shutil.rmtree(images / "scans")
    (images / "maps").mkdir()
    (images / "maps/town.ply").touch()
    drive = read_drive(scene_at(images, "plain"), lambda _: None)
    assert not drive.has_scans and drive.unread == () and all(row.image_valid for row in drive.images)
    shutil.rmtree(layout.root / "images")
    layout.cameras_path.unlink()
    drive = read_drive(scene_at(layout.root, "plain"), lambda _: None)
    assert drive.unread == () and all(row.scan_valid for row in drive.frames)


def test_a_described_camera_without_images_is_left_out_by_name(layout):
    shutil.rmtree(layout.root / "images")
    notes = drive_of(scene_at(layout.root, "plain")).facts().calibration.notes
    assert notes == ("left left out: no images of it",)


def test_scans_of_kitti360_in_another_folder_are_refused(tmp_path):
    write_demo(tmp_path, size=DemoSize.tiny())
    scene = tiny_scene(tmp_path)
    scans = DriveLayout(tmp_path, scene.sequence).scan_path(0).parent
    assert read_drive(scene, lambda _: None).unread == ()
    scans.rename(scans.parent / "scans")
    with pytest.raises(DataError, match=r"velodyne_points/scans: found 4 files as .*, and none"):
        read_drive(scene, lambda _: None)
