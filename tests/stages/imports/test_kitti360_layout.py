"""A drive imported in KITTI-360's layout keeps its objects apart, and says what the layout cannot hold."""

import json

import numpy as np
import pytest

from nvsf_core.drives.detect import whole_drive
from nvsf_core.drives.drive import drive_of
from nvsf_core.drives.kitti360.boxes import Box
from nvsf_core.drives.kitti360.calibration import CameraCalibration
from nvsf_core.drives.kitti360.layout import CAMERAS
from nvsf_core.drives.kitti360.scans import Scan
from nvsf_core.drives.kitti360.writer import flat_fisheye
from nvsf_core.drives.plain.layout import PlainLayout
from nvsf_core.drives.plain.writer import (
    write_cameras,
    write_description,
    write_image_times,
    write_plain_boxes,
    write_plain_image,
    write_plain_scan,
    write_poses,
)
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.stages.imports.convert import import_drive
from nvsf_core.stages.imports.kitti360_layout import layout_names

FRAMES, STEP_S, POINTS = 4, 0.5, 400
CAMERA = Pinhole(fx=20.0, fy=20.0, cx=15.5, cy=11.5, width=32, height=24)
MOUNTING = np.array([[0.0, 0.0, 1.0, 0.3], [-1.0, 0.0, 0.0, 0.1], [0.0, -1.0, 0.0, -0.2], [0, 0, 0, 1]])
RIG = ("back", "front", "left", "middle", "right")
OBJECTS = {26_001: "car", 3017: "car", 17: "caravan"}


def _box(object_id: int, label: str) -> Box:
    pose = np.diag([4.0, 2.0, 1.5, 1.0])
    pose[:3, 3] = 10.0, float(object_id % 7), 0.0
    return Box(frame=-1, object_id=object_id, label=label, dynamic=False, box_to_world=pose)


@pytest.fixture
def recorded(tmp_path):
    layout = PlainLayout(tmp_path / "plain")
    write_description(layout, "VLP-16")
    moments_s = (STEP_S * np.arange(FRAMES)).tolist()
    write_poses(layout, range(FRAMES), moments_s, [np.eye(4)] * FRAMES)
    write_cameras(layout, dict.fromkeys(RIG, (CAMERA, MOUNTING)))
    fraction = np.linspace(-0.5, 0.5, POINTS, endpoint=False)
    angle = -2.0 * np.pi * fraction
    rows = np.stack([9.0 * np.cos(angle), 9.0 * np.sin(angle), np.zeros(POINTS), np.full(POINTS, 0.5)], 1)
    rng = np.random.default_rng(0)
    for frame in range(FRAMES):
        ring = np.arange(POINTS) % 16
        write_plain_scan(layout, frame, Scan(rows.astype(np.float32), 0, ring=ring, offset_s=0.05 * fraction))
        for camera in RIG:
            write_plain_image(layout, camera, frame, rng.integers(0, 255, (24, 32, 3), np.uint8))
    write_image_times(layout, "left", {frame: moments_s[frame] + 0.02 for frame in range(FRAMES)})
    write_plain_boxes(layout, [_box(*one) for one in OBJECTS.items()])
    return layout.root


def test_what_the_layout_cannot_hold_is_said(recorded, tmp_path):
    done = import_drive(whole_drive(recorded, "plain"), tmp_path / "out", layout="kitti360", progress=print)
    assert (done.scans, done.images) == (4, 16)
    assert [words.split(":")[0] for words in done.left_out] == [
        "camera right",
        "times of images of left, up to 20.0 ms from their frames'",
        "rings of the points of 4 scans",
        "times of the points of 4 scans",
    ]
    assert json.loads((tmp_path / "out/import.json").read_text())["left_out"] == list(done.left_out)
    kept = import_drive(whole_drive(recorded, "plain"), tmp_path / "kept", layout="plain", progress=print)
    assert kept.left_out == ()


@pytest.mark.parametrize("first", [7, 3_000_000])
def test_timestamps_of_high_frame_numbers_are_few_and_are_read_again(tmp_path, first):
    layout, moments_s = PlainLayout(tmp_path / "plain"), [0.0, 0.1, 0.21, 0.3]
    write_poses(layout, range(first, first + FRAMES), moments_s, [np.eye(4)] * FRAMES)
    points = np.random.default_rng(0).uniform(2.0, 9.0, (100, 4)).astype(np.float32)
    points[:, 3] = 0.5
    for frame in range(first, first + FRAMES):
        write_plain_scan(layout, frame, Scan(points, 0))
    done = import_drive(whole_drive(layout.root, "plain"), tmp_path / "out", layout="kitti360", progress=str)
    assert sum(path.stat().st_size for path in (tmp_path / "out").rglob("timestamps*.txt")) < 10_000
    assert any("timestamps have lines of frames" in words for words in done.notes) == (first > 7)
    found = drive_of(whole_drive(tmp_path / "out", "kitti360")).times()
    assert not found.is_assumed and np.allclose(found.time_s, moments_s, atol=2e-6)


def test_a_camera_of_another_name_is_read_back_under_the_one_that_is_said(recorded, tmp_path):
    done = import_drive(whole_drive(recorded, "plain"), tmp_path / "out", layout="kitti360", progress=print)
    assert [words for words in done.notes if words.startswith("camera")] == [
        "camera back is image_00 of the layout",
        "camera front is image_01 of the layout",
        "camera left is image_02 of the layout, as a MEI camera with xi = 0",
        "camera middle is image_03 of the layout, as a MEI camera with xi = 0",
    ]
    source, found = (
        drive_of(whole_drive(recorded, "plain")),
        drive_of(whole_drive(tmp_path / "out", "kitti360")),
    )
    model = found.facts().calibration.cameras["image_03"].intrinsics
    points_m = np.array([[0.3, -0.2, 1.0], [-0.5, 0.1, 2.0]])
    assert np.allclose(model.project(points_m)[0], CAMERA.project(points_m)[0])
    images = [
        drive.parse_image(name, drive.find_image(name, 2, 32, 24), 32, 24)
        for drive, name in ((source, "middle"), (found, "image_03"))
    ]
    assert np.array_equal(*images)


FISHEYE = flat_fisheye(CAMERA)


@pytest.mark.parametrize(
    ("models", "names"),
    [
        (dict.fromkeys(CAMERAS, CAMERA), dict(zip(CAMERAS, CAMERAS, strict=True))),
        ({"image_00": CAMERA, "image_02": CAMERA}, {"image_00": "image_00", "image_02": "image_02"}),
        ({"image_02": CAMERA, "image_03": CAMERA}, {"image_02": "image_00", "image_03": "image_01"}),
        ({"image_00": CAMERA, "image_02": FISHEYE}, {"image_00": "image_00", "image_02": "image_02"}),
        ({"image_00": FISHEYE, "a": CAMERA}, {"image_00": "image_02", "a": "image_00"}),
        (
            {"image_00": CAMERA, "image_02": CAMERA, "up": FISHEYE, "down": FISHEYE, "aft": FISHEYE},
            {"image_00": "image_00", "image_02": "image_01", "up": "image_02", "down": "image_03"},
        ),
    ],
    ids=["KITTI", "two of KITTI", "KITTI in colour", "KITTI-360", "named otherwise", "fisheyes first"],
)
def test_cameras_of_the_layout_keep_their_place_where_it_can_hold_them(models, names):
    cameras = {
        name: CameraCalibration(name=name, intrinsics=model, to_pose=MOUNTING)
        for name, model in models.items()
    }
    assert layout_names(cameras) == names


def test_a_sweep_that_is_shorter_than_the_step_stays_so(recorded, tmp_path):
    import_drive(whole_drive(recorded, "plain"), tmp_path / "out", layout="kitti360", progress=print)
    times = drive_of(whole_drive(tmp_path / "out", "kitti360")).times()
    assert np.allclose(np.diff(times.time_s), STEP_S) and times.sweep_period_s == pytest.approx(0.05)


def test_objects_stay_apart_and_those_of_the_layout_keep_their_number(recorded, tmp_path):
    import_drive(whole_drive(recorded, "plain"), tmp_path / "out", layout="kitti360", progress=print)
    boxes = drive_of(whole_drive(tmp_path / "out", "kitti360")).boxes().boxes
    assert {one.object_id: one.label for one in boxes} == {26_001: "car", 26_017: "car", 29_017: "caravan"}


@pytest.mark.parametrize("layout", ["plain", "kitti360"])
def test_another_lidar_than_the_assumed_one_is_still_to_be_found_after_an_import(tmp_path, layout):
    # KITTI odometry's layout names no sensor; these are 16 lasers, two degrees apart.
    sequence = tmp_path / "odometry/sequences/00"
    (sequence / "velodyne").mkdir(parents=True)
    azimuth, elevation = np.meshgrid(
        np.arange(0.0, 2.0 * np.pi, 0.01), np.radians(np.arange(15.0, -16.0, -2.0))
    )
    flat = 20.0 * np.cos(elevation)
    points = [
        flat * np.cos(azimuth),
        flat * np.sin(azimuth),
        20.0 * np.sin(elevation),
        np.full(flat.shape, 0.5),
    ]
    rows = np.stack(points, axis=-1).reshape(-1, 4).astype("<f4")
    (tmp_path / "odometry/poses").mkdir()
    line = "1 0 0 0 0 1 0 0 0 0 1 "
    (tmp_path / "odometry/poses/00.txt").write_text("".join(f"{line}{frame}\n" for frame in range(3)))
    (sequence / "times.txt").write_text("".join(f"{0.1 * frame}\n" for frame in range(3)))
    (sequence / "calib.txt").write_text("Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n")
    for frame in range(3):
        (sequence / f"velodyne/{frame:06d}.bin").write_bytes(rows.tobytes())
    scene = whole_drive(tmp_path / "odometry", "kitti_odometry")
    done = import_drive(scene, tmp_path / "out", layout=layout, progress=lambda line: None)
    assert any("not of an HDL-64E" in note for note in done.notes)
    file = done.folder / ("drive.json" if layout == "plain" else "scenes.toml")
    assert '"found"' in file.read_text()
