from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from nvsf_core.drives.kitti360.boxes import STATIC_FRAME, Box, read_boxes
from nvsf_core.drives.kitti360.calibration import read_mei, read_pinhole
from nvsf_core.drives.kitti360.scans import write_scan
from nvsf_core.drives.kitti360.text import KeyedText
from nvsf_core.drives.kitti360.writer import (
    RectifiedCamera,
    write_boxes,
    write_fisheye,
    write_grey,
    write_image,
    write_perspective,
)
from nvsf_core.errors import DataError, ShapeError
from nvsf_core.geometry.fisheye import MeiFisheye
from nvsf_core.geometry.pinhole import Pinhole


def test_scan_round_trips(tmp_path):
    rng = np.random.default_rng(0)
    points, intensity = rng.normal(size=(50, 3)).astype("f4"), rng.random(50).astype("f4")
    write_scan(tmp_path / "a" / "0.bin", points, intensity)
    rows = np.fromfile(tmp_path / "a" / "0.bin", "<f4").reshape(-1, 4)
    assert np.array_equal(rows, np.column_stack([points, intensity]))


def test_scan_refuses_what_is_no_scan(tmp_path):
    with pytest.raises(ShapeError):
        write_scan(tmp_path / "0.bin", np.zeros((4, 3)), np.zeros(3))
    with pytest.raises(DataError):
        write_scan(tmp_path / "0.bin", np.full((4, 3), np.nan), np.zeros(4))
    assert not (tmp_path / "0.bin").exists()


def test_image_keeps_red_red(tmp_path):
    rgb = np.zeros((4, 6, 3), np.uint8)
    rgb[..., 0] = 200
    write_image(tmp_path / "0.png", rgb)
    assert np.array_equal(cv2.imread(str(tmp_path / "0.png"))[..., ::-1], rgb)
    with pytest.raises(ShapeError):
        write_image(tmp_path / "0.png", rgb.astype(float))


def test_calibration_is_read_back(tmp_path):
    fisheye = MeiFisheye(2.2, 0.01, 1.6, 4e-4, -3e-4, 334.0, 333.0, 178.0, 175.0, 350, 349)
    write_fisheye(tmp_path / "image_02.yaml", "image_02", fisheye)
    read = read_mei(tmp_path / "image_02.yaml")
    for name in ("xi", "k1", "k2", "p1", "p2", "gamma1", "gamma2", "u0", "v0", "width", "height"):
        assert getattr(read, name) == getattr(fisheye, name)

    camera = RectifiedCamera(Pinhole(276.0, 276.0, 340.0, 119.0, 704, 188), 0.6)
    write_perspective(tmp_path / "perspective.txt", {"image_00": camera, "image_01": camera})
    pinhole = read_pinhole(KeyedText.read(tmp_path / "perspective.txt"), "image_01")
    assert (pinhole.width, pinhole.height, pinhole.fx, pinhole.cx, pinhole.cy) == (
        704,
        188,
        276.0,
        340.0,
        119.0,
    )


def _box(number: int, label: str, pose: np.ndarray) -> Box:
    return Box(frame=3, object_id=number, label=label, dynamic=True, box_to_world=pose)


def test_boxes_are_read_back(tmp_path):
    pose = np.diag([4.0, 1.8, 1.5, 1.0])
    pose[:3, 3] = 1012.25, 3688.5, 114.0
    boxes = [_box(1, "car", pose), replace(_box(7, "car", pose), dynamic=False, frame=STATIC_FRAME)]
    write_boxes(tmp_path / "boxes.xml", boxes, 0, 9)
    (moving, parked), _ = read_boxes(tmp_path / "boxes.xml", 0, 9)
    assert (moving.frame, moving.dynamic, moving.label) == (3, True, "car")
    assert (parked.frame, parked.dynamic) == (-1, False)
    assert moving.object_id != parked.object_id
    assert np.allclose(moving.box_to_world, pose, atol=1e-4)


def test_any_label_comes_back(tmp_path: Path) -> None:
    labels = ["Car & Trailer", "pedestrian <1m", "</label><object9>", "Großraum"]
    boxes = [_box(k, label, np.eye(4)) for k, label in enumerate(labels)]
    write_boxes(tmp_path / "boxes.xml", [*boxes, _box(9, "be\x07ll", np.eye(4))], 0, 9)
    found, left_out = read_boxes(tmp_path / "boxes.xml", 0, 9)
    assert [one.label for one in found] == [*labels, "bell"] and not left_out


def test_boxes_keep_their_place_at_utm_coordinates(tmp_path):
    pose = np.diag([4.0, 1.8, 1.5, 1.0])
    pose[:3, 3] = 455_123.4567, 5_428_765.4321, 115.0
    write_boxes(tmp_path / "boxes.xml", [_box(1, "car", pose)], 0, 9)
    ((box,), _) = read_boxes(tmp_path / "boxes.xml", 0, 9)
    assert np.allclose(box.box_to_world, pose, rtol=0.0, atol=1e-5)


def test_classes_of_pixels_come_back_as_they_were(tmp_path: Path) -> None:
    classes = np.random.default_rng(0).integers(0, 3, (6, 9)).astype(np.uint8)
    write_grey(tmp_path / "support" / "0.png", classes, np.uint8)
    assert (cv2.imread(str(tmp_path / "support" / "0.png"), cv2.IMREAD_UNCHANGED) == classes).all()
    with pytest.raises(ShapeError):
        write_grey(tmp_path / "1.png", classes[None], np.uint8)
