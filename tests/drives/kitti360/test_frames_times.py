from pathlib import Path

import numpy as np
import pytest

from nvsf_core.drives.kitti360.frames import frame_times
from nvsf_core.drives.kitti360.layout import DriveLayout
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
