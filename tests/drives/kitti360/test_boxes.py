from pathlib import Path

import numpy as np
import pytest

from nvsf_core.drives.kitti360.boxes import class_of, number_in_boxes, read_boxes
from nvsf_core.drives.kitti360.writer import write_cam_to_pose
from nvsf_core.errors import DataError
from tests.conftest import SHARED

REAL = SHARED / "data" / "kitti0005_van_cyclist"
CUBE = "-.5 -.5 -.5  .5 .5 .5"
TRANSFORM = "4 0 0 10  0 2 0 20  0 0 1.5 30  0 0 0 1"


def box(timestamp: int = 12, *, transform: str = TRANSFORM, vertices: str = CUBE, extra: str = "") -> str:
    return f"""<object><label>car</label><semanticId>26</semanticId><instanceId>7</instanceId>
    <timestamp>{timestamp}</timestamp><start_frame>5</start_frame><end_frame>15</end_frame>{extra}
    <transform type_id="opencv-matrix"><rows>4</rows><cols>4</cols><dt>f</dt>
    <data>{transform}</data></transform>
    <vertices type_id="opencv-matrix"><rows>2</rows><cols>3</cols><dt>f</dt>
    <data>{vertices}</data></vertices>
    </object>"""


def written(path: Path, *boxes: str, head: str = '<?xml version="1.0"?>') -> Path:
    path.write_text(f"{head}\n<opencv_storage>{''.join(boxes)}<other>1</other></opencv_storage>")
    return path


def test_a_moving_box_is_the_unit_cube_in_the_world_in_its_frame(tmp_path: Path) -> None:
    (found,), _ = read_boxes(written(tmp_path / "b.xml", box(12), box(99)), 10, 20)
    assert (found.frame, found.object_id, found.label, found.dynamic) == (12, 26007, "car", True)
    assert np.allclose(found.box_to_world @ [0.5, 0.5, 0.5, 1.0], [12.0, 21.0, 30.75, 1.0])


def test_a_box_with_vertices_of_its_own_is_bounded_by_them(tmp_path: Path) -> None:
    (found,), _ = read_boxes(written(tmp_path / "b.xml", box(vertices="0 0 0  1 2 4")), 10, 20)
    assert np.allclose(found.box_to_world @ [-0.5, -0.5, -0.5, 1.0], [10.0, 20.0, 30.0, 1.0])
    assert np.allclose(found.box_to_world @ [0.5, 0.5, 0.5, 1.0], [14.0, 24.0, 36.0, 1.0])


def test_a_standing_box_counts_where_its_window_meets_the_section(tmp_path: Path) -> None:
    path = written(tmp_path / "b.xml", box(-1))
    (found,), _ = read_boxes(path, 15, 20)
    assert found.frame == -1 and not found.dynamic
    assert read_boxes(path, 16, 20) == ([], [])


def test_the_file_may_say_itself_what_moves(tmp_path: Path) -> None:
    (found,), _ = read_boxes(written(tmp_path / "b.xml", box(extra="<dynamic>0</dynamic>")), 10, 20)
    assert not found.dynamic


def test_entities_are_refused(tmp_path: Path) -> None:
    bomb = '<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]>'
    with pytest.raises(DataError, match=r"cannot read boxes .*b\.xml"):
        read_boxes(written(tmp_path / "b.xml", box(), head=bomb), 10, 20)


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (box(transform="1 2 3"), "expected 16 numbers, found 3"),
        (box(transform=TRANSFORM.replace("10", "nan")), "finite"),
        (box().replace("<instanceId>7</instanceId>", ""), "field 'instanceId' is missing"),
        (box().replace("<timestamp>12", "<timestamp>noon"), "timestamp: expected a whole number"),
    ],
)
def test_a_garbled_box_names_file_and_field(tmp_path: Path, bad: str, reason: str) -> None:
    with pytest.raises(DataError, match=rf"b\.xml, element object: .*{reason}"):
        read_boxes(written(tmp_path / "b.xml", bad), 10, 20)


def test_an_unfinished_file_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path / "b.xml", box())
    path.write_text(path.read_text()[:-40])
    with pytest.raises(DataError, match="cannot read boxes"):
        read_boxes(path, 10, 20)


def test_the_real_drive_has_a_van_and_a_cyclist_in_every_frame_and_a_parked_van() -> None:
    path = REAL / "data_3d_bboxes" / "train" / "2013_05_28_drive_9005_sync.xml"
    if not path.is_file():
        pytest.skip(f"no real data at {REAL}")
    boxes, left_out = read_boxes(path, 10, 39)
    assert left_out == []
    moving = {(b.frame, b.label) for b in boxes if b.dynamic}
    assert moving == {(frame, label) for frame in range(10, 40) for label in ("car", "rider")}
    assert [b.frame for b in boxes if not b.dynamic] == [-1]
    assert all(1.0 < np.linalg.norm(b.box_to_world[:3, 0]) < 7.0 for b in boxes)


def test_numbers_of_classes_are_those_of_images_whatever_numbers_a_file_has() -> None:
    # kitti360Scripts turns a box's 13 (car) into the 26 of instance images, 21 (a pole) into 17.
    assert class_of("car", 13) == 26 and class_of("bigPole", 21) == 17
    assert class_of("car", 26) == 26, "as writers that know of one numbering only have it"
    assert class_of("van", 0) == 27 and class_of("Person (sitting)", 37) == 24 and class_of("lorry", 99) == 99
    assert [number_in_boxes(name) for name in ("car", "unknownVehicle", "traffic sign")] == [13, 36, 24]
    assert number_in_boxes("dynamic") == 37, "an unknown object"


def test_the_data_sets_own_scripts_find_all_four_cameras(tmp_path: Path) -> None:
    pose = np.eye(4)
    pose[:3, 3] = 1.0, 2.0, 3.0
    write_cam_to_pose(tmp_path / "calib_cam_to_pose.txt", {"image_02": pose})
    lines = (tmp_path / "calib_cam_to_pose.txt").read_text().splitlines()
    assert [line.split(":")[0] for line in lines] == ["image_00", "image_01", "image_02", "image_03"]
