from datetime import datetime
from pathlib import Path

import numpy as np
import pytest

from nvsf_core.drives.kitti360.frames import frame_times
from nvsf_core.drives.kitti360.layout import DriveLayout
from nvsf_core.drives.kitti360.writer import write_timestamps
from nvsf_core.errors import DataError


def drive(root: Path, stamps: list[str] | None, recorded: range = range(10, 13)) -> DriveLayout:
    layout = DriveLayout(root, "s_sync")
    layout.scan_path(0).parent.mkdir(parents=True)
    for frame in recorded:
        layout.scan_path(frame).touch()
    if stamps is not None:
        layout.timestamps_path().write_text("\n".join(stamps) + "\n")
    return layout


def ticks(n: int) -> list[str]:
    """A stamp per frame, each gap longer than the one before, across a midnight."""
    start = np.datetime64("2013-05-28T23:59:59.000000001", "ns")
    offsets_ns = [100_000_000 * i + 1_000_000 * i * i for i in range(n)]
    return [str(start + np.timedelta64(offset, "ns")).replace("T", " ") for offset in offsets_ns]


def test_a_whole_drives_file_is_indexed_by_frame_number(tmp_path: Path) -> None:
    times = frame_times(drive(tmp_path, ticks(50)), 10, 12, None)
    assert not times.is_assumed and times.source.endswith("velodyne_points/timestamps.txt")
    assert np.allclose(times.time_s, [0.0, 0.121, 0.244], atol=1e-12)
    assert times.sweep_period_s == pytest.approx(0.122)


def test_a_cut_out_drives_file_is_indexed_by_position(tmp_path: Path) -> None:
    layout = drive(tmp_path, ticks(6), range(10, 16))
    assert np.allclose(frame_times(layout, 10, 12, None).time_s, [0.0, 0.101, 0.204])
    assert np.allclose(frame_times(layout, 12, 14, None).time_s, [0.0, 0.105, 0.212])


def test_a_cut_out_longer_than_its_frame_numbers_is_still_indexed_by_position(tmp_path: Path) -> None:
    layout = drive(tmp_path, ticks(30), range(3, 33))
    assert np.allclose(frame_times(layout, 3, 5, None).time_s, [0.0, 0.101, 0.204])


def paced(root: Path, step_s: float, sweep_s: float, lines: int = 20) -> DriveLayout:
    """A drive whose frames are so far apart and whose files of begins and ends give the sweep."""
    layout = drive(root, None)
    stamps_s = step_s * np.arange(lines)
    for kind, shift in (("", 0.0), ("start", -0.5), ("end", 0.5)):
        write_timestamps(
            layout.timestamps_path(kind), datetime(2013, 5, 28), (stamps_s + shift * sweep_s).tolist()
        )
    return layout


@pytest.mark.parametrize(
    ("step_s", "sweep_s", "given_s", "expected_s"),
    [
        (0.2, 0.1, None, 0.1), (0.05, 0.1, None, 0.1), (0.10326, 0.1, None, 0.10326), (0.2, 0.1, 0.15, 0.15),
        (0.1, 0.1, 0.05, 0.05), (0.1, 0.1, 0.1046, 0.1), (0.1, -0.1, None, 0.1),
    ],
)  # fmt: skip
def test_a_sweep_lasts_from_its_begin_to_its_end_unless_that_is_about_the_step(
    tmp_path: Path, step_s: float, sweep_s: float, given_s: float | None, expected_s: float
) -> None:
    times = frame_times(paced(tmp_path, step_s, sweep_s), 10, 12, given_s)
    assert not times.is_assumed and np.allclose(np.diff(times.time_s), step_s)
    assert times.sweep_period_s == pytest.approx(expected_s, abs=1e-6)


def test_begins_and_ends_count_only_where_all_three_files_have_the_same_lines(tmp_path: Path) -> None:
    layout = paced(tmp_path, 0.2, 0.1)
    lines = layout.timestamps_path("end").read_text().splitlines()
    layout.timestamps_path("end").write_text("\n".join(["", *lines[1:10], "", *lines[11:]]) + "\n")
    assert frame_times(layout, 10, 12, None).sweep_period_s == pytest.approx(0.1), "the others' median"
    layout.timestamps_path("end").write_text("\n".join(lines[:-1]) + "\n")
    assert frame_times(layout, 10, 12, None).sweep_period_s == pytest.approx(0.2)
    layout.timestamps_path("end").write_text("\n".join(["yesterday", *lines[1:]]) + "\n")
    assert frame_times(layout, 10, 12, None).sweep_period_s == pytest.approx(0.2), "not refused"
    layout.timestamps_path("end").unlink()
    assert frame_times(layout, 10, 12, None).sweep_period_s == pytest.approx(0.2)


def test_without_a_file_the_nominal_period_is_recorded_as_assumed(tmp_path: Path) -> None:
    layout = drive(tmp_path, None)
    times = frame_times(layout, 10, 12, 0.1046)
    assert times.is_assumed and times.sweep_period_s == 0.1046 and "no timestamp file" in times.source
    assert np.allclose(times.time_s, [0.0, 0.1046, 0.2092])
    assert frame_times(layout, 10, 12, None).sweep_period_s == 0.1


@pytest.mark.parametrize(
    ("stamps", "reason"),
    [
        (ticks(7), "neither by number nor by count"),
        ([*ticks(11), "", *ticks(20)[12:]], "gaps or steps back"),
        ([*ticks(11), ticks(1)[0], *ticks(20)[12:]], "gaps or steps back"),
    ],
)
def test_a_file_that_does_not_fit_is_not_used_and_the_reason_is_kept(
    tmp_path: Path, stamps: list[str], reason: str
) -> None:
    times = frame_times(drive(tmp_path, stamps), 10, 12, 0.1)
    assert times.is_assumed and reason in times.source


def test_a_line_that_is_no_time_names_file_line_and_remedy(tmp_path: Path) -> None:
    layout = drive(tmp_path, [*ticks(3), "yesterday", *ticks(20)])
    with pytest.raises(DataError, match=r"timestamps\.txt, line 4: .*yesterday.*remove it"):
        frame_times(layout, 10, 12, None)


def test_a_camera_only_drive_takes_its_cameras_times(tmp_path: Path) -> None:
    layout = DriveLayout(tmp_path, "s_sync")
    layout.camera_dir("image_00").mkdir(parents=True)
    layout.camera_timestamps_path("image_00").write_text("\n".join(ticks(50)))
    assert np.allclose(frame_times(layout, 10, 12, None).time_s, [0.0, 0.121, 0.244])


def test_one_frame_has_the_nominal_period(tmp_path: Path) -> None:
    times = frame_times(drive(tmp_path, ticks(50)), 10, 10, 0.1)
    assert times.time_s.tolist() == [0.0] and times.sweep_period_s == 0.1
