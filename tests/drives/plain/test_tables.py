"""A plain drive's tables: bad boxes are left out by line and column, and a table takes little memory."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from nvsf_core.drives.plain.box_table import read_box_table
from nvsf_core.drives.plain.tables import read_columns, read_pose_table, read_times
from nvsf_core.errors import DataError

COLUMNS = "frame,object_id,label,dynamic,x,y,z,qx,qy,qz,qw,length,width,height"
GOOD = "0,7,Car,1,10,2,0,0,0,0,1,4,2,1.5"


def test_a_drive_without_objects_has_a_table_of_boxes_without_rows(tmp_path):
    columns = "frame,object_id,label,dynamic,x,y,z,qx,qy,qz,qw,length,width,height"
    (tmp_path / "boxes.csv").write_text(columns + "\n")
    assert read_box_table(tmp_path / "boxes.csv", range(4), range(4)) == ([], [])
    (tmp_path / "boxes.csv").write_text("frame,object_id\n")
    with pytest.raises(DataError, match="label"):
        read_box_table(tmp_path / "boxes.csv", range(4), range(4))
    (tmp_path / "boxes.csv").write_text("")
    with pytest.raises(DataError, match="found 0 rows"):
        read_box_table(tmp_path / "boxes.csv", range(4), range(4))


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        ("0,7,Car,1,10,two,0,0,0,0,1,4,2,1.5", "y: expected a finite number, found 'two'"),
        ("0,7,Car,1,10,nan,0,0,0,0,1,4,2,1.5", "y: expected a finite number, found 'nan'"),
        ("0,7,Car,1,10,2,0,0,0,0,0,4,2,1.5", "qx, qy, qz, qw: expected a quaternion of length 1"),
        ("0,-7,Car,1,10,2,0,0,0,0,1,4,2,1.5", "object_id: expected a whole number 0 to"),
        ("0.5,7,Car,1,10,2,0,0,0,0,1,4,2,1.5", "frame: expected a whole number -1 to"),
        ("0,7,Car,yes,10,2,0,0,0,0,1,4,2,1.5", "dynamic: expected a finite number, found 'yes'"),
        ("-1,7,Car,1,10,2,0,0,0,0,1,4,2,1.5", "dynamic: expected 0 of a static box (frame -1), found 1"),
        ("0,7,Car,1,10,2,0,0,0,0,1,4,2,0", "length, width, height: expected 1 mm to 1 km"),
        ("0,7,Car,1,10,2,0", "expected 14 cells, found 7"),
    ],
)
def test_a_bad_box_is_left_out_by_line_and_column_and_the_others_are_read(
    tmp_path: Path, bad: str, reason: str
) -> None:
    path = tmp_path / "boxes.csv"
    path.write_text(
        "\n".join(["# of a labeller", COLUMNS, GOOD, "", bad, GOOD.replace("0,7", "9,8", 1), GOOD])
    )
    boxes, left_out = read_box_table(path, range(4), range(10))
    assert [(box.frame, box.object_id, box.label) for box in boxes] == [(0, 7, "Car")] * 2
    assert np.allclose(boxes[0].box_to_world[:3, 3], [10.0, 2.0, 0.0])
    (words,) = left_out
    assert words.startswith(f"line 5 of boxes.csv: {reason}")


def test_a_table_takes_the_memory_of_its_numbers(tmp_path: Path) -> None:
    path, rows, columns = tmp_path / "poses.csv", 20_000, 20
    path.write_text(",".join(f"c{k}" for k in range(columns)) + "\n" + ("1," * (columns - 1) + "1\n") * rows)
    tracemalloc.start()
    found = read_columns(path, [f"c{k}" for k in range(columns)])
    _, most_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(found["c0"]) == rows and all((one == 1.0).all() for one in found.values())
    assert most_bytes < 12 * rows * columns


@pytest.mark.parametrize("text", ["a\n" + "1" * 70_000, "a,b\n" + '"1\n",' * 100, "a\n" + "1," * 40_000])
def test_an_endless_line_is_refused_before_it_is_whole(tmp_path: Path, text: str) -> None:
    path = tmp_path / "poses.csv"
    path.write_text(text)
    with pytest.raises(
        DataError, match=r"cannot read .*poses\.csv \((line 2: expected at most 65,536|unexp)"
    ):
        read_columns(path, ["a"])


@pytest.mark.parametrize(("unit", "begin"), [(1e6, 1_700_000_000), (1e6, 0), (1e9, 0), (1e3, 0)])
def test_whole_times_of_another_unit_are_refused_with_what_to_divide_by(
    tmp_path: Path, unit: float, begin: int
) -> None:
    rows = [f"{frame},{(begin + 0.1 * frame) * unit:.0f}" for frame in range(4)]
    (tmp_path / "frames.csv").write_text("\n".join(["frame,time_s", *rows]))
    with pytest.raises(DataError, match=r"frames\.csv: time_s: expected seconds.*microseconds by 1e6"):
        read_times(tmp_path / "frames.csv")
    poses = [f"{row.partition(',')[2]},0,0,0,0,0,0,1" for row in rows]
    (tmp_path / "poses.csv").write_text("\n".join(["time_s,x,y,z,qx,qy,qz,qw", *poses]))
    with pytest.raises(DataError, match=r"poses\.csv: time_s: expected seconds"):
        read_pose_table(tmp_path / "poses.csv")


POSES = ["frame,time_s,x,y,z,qx,qy,qz,qw,driver", "0,0.0,0,0,0,0,0,0,1,Ann", "1,0.1,1,0,0,0,0,0,1,"]


def test_a_column_that_is_not_used_may_hold_words(tmp_path: Path) -> None:
    (tmp_path / "poses.csv").write_text("\n".join(POSES))
    path, frames = read_pose_table(tmp_path / "poses.csv")
    assert frames is not None and frames.tolist() == [0, 1] and path.poses[1, 0, 3] == 1.0


@pytest.mark.parametrize("separator", [";", "\t", " ", "|"])
def test_a_table_without_commas_is_refused_with_what_is_expected(tmp_path: Path, separator: str) -> None:
    (tmp_path / "poses.csv").write_text("\n".join(POSES).replace(",", separator))
    with pytest.raises(DataError, match=r"poses\.csv: expected names and numbers apart by commas, found"):
        read_pose_table(tmp_path / "poses.csv")


@pytest.mark.parametrize(
    ("row", "reason"),
    [
        ("1700000000.2,0,0,0,0,0,0,1", "found 1700000000.2 in line 7, after 1700000000.3; sort the rows"),
        ("1700000000.3,0,0,0,0,0,0,1", "found 1700000000.3 in line 7, after 1700000000.3; sort the rows"),
        ("1700000000.4,0,0,0,0,0,0,3", "line 7: expected a quaternion of length 1"),
        ("1700000000.4,1e9,0,0,0,0,0,1", "line 7: expected a translation within"),
    ],
)
def test_a_bad_pose_is_named_by_its_line_and_its_time_told_apart_from_the_one_before(
    tmp_path: Path, row: str, reason: str
) -> None:
    good = [f"1700000000.{k},0,0,0,0,0,0,1" for k in (1, 2, 3)]
    (tmp_path / "poses.csv").write_text(
        "\n".join(["time_s,x,y,z,qx,qy,qz,qw", "# of a logger", *good, "", row, "1700000000.5,0,0,0,0,0,0,1"])
    )
    with pytest.raises(DataError) as refused:
        read_pose_table(tmp_path / "poses.csv")
    assert reason in str(refused.value)
