"""A plain drive's scans and times: as its files say, or refused with what mends it."""

from pathlib import Path

import numpy as np
import pytest

from nvsf_core.drives.drive import DriveFacts, drive_of
from nvsf_core.drives.kitti360.scans import Scan
from nvsf_core.drives.plain.layout import PlainLayout
from nvsf_core.drives.plain.writer import (
    write_cameras,
    write_description,
    write_image_times,
    write_plain_image,
    write_plain_scan,
    write_poses,
)
from nvsf_core.drives.validation import read_drive
from nvsf_core.errors import DataError
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.stages.imports.convert import import_drive
from tests.drives.copies import FRAMES, scene_at

POINTS = 600


def _write(root: Path, step_s: float, sweep_s: float | None, begin_s: float = 0.0) -> PlainLayout:
    """A drive at 10 m/s of scans whose points are stamped by their azimuth; None = by nothing."""
    layout = PlainLayout(root)
    write_description(layout, "VLP-16")
    moments_s = begin_s + step_s * np.arange(FRAMES)
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, 0, 3] = 10.0 * moments_s
    write_poses(layout, range(FRAMES), moments_s.tolist(), list(poses))
    fraction = np.linspace(-0.5, 0.5, POINTS, endpoint=False)
    angle = -2.0 * np.pi * fraction
    rows = np.stack([9.0 * np.cos(angle), 9.0 * np.sin(angle), np.zeros(POINTS), np.full(POINTS, 0.5)], 1)
    for frame in range(FRAMES):
        scan = Scan(rows.astype(np.float32), 0, offset_s=None if sweep_s is None else sweep_s * fraction)
        write_plain_scan(layout, frame, scan)
    return layout


def _facts(root: Path, **values: object) -> DriveFacts:
    return drive_of(scene_at(root, "plain", **values)).facts()


def test_a_given_duration_of_a_sweep_is_kept_where_frames_are_farther_apart(tmp_path):
    _write(tmp_path, 0.5, None)
    facts = _facts(tmp_path, sweep_period_s=0.05)
    assert facts.times.sweep_period_s == 0.05
    assert facts.times.time_s.tolist() == [0.0, 0.5, 1.0, 1.5]
    assert "a sweep lasts 0.05 s, frames are 0.5 s apart in the median" in facts.notes
    # Also of frames that are not there.
    longer = _facts(tmp_path, sweep_period_s=0.05, last_frame=FRAMES)
    assert longer.times.time_s[-1] == pytest.approx(0.5 * FRAMES)
    assert _facts(tmp_path).times.sweep_period_s == 0.5
    assert any("give sweep_period_s in the catalogue" in note for note in _facts(tmp_path).notes)


@pytest.mark.parametrize("apart_s", [0.0, 0.0005, 0.02, -0.03])
def test_poses_of_frames_at_other_times_than_frames_csv_says_are_refused(tmp_path, apart_s):
    layout = _write(tmp_path, 0.1, 0.1, begin_s=1e6)
    rows = [f"{frame},{1e6 + 0.1 * frame + apart_s * (frame == 2):.6f}" for frame in range(FRAMES)]
    layout.frames_path.write_text("\n".join(["frame,time_s", *rows]))
    if abs(apart_s) < 0.001:
        assert len(_facts(tmp_path).poses) == FRAMES
        return
    with pytest.raises(DataError, match=r"poses\.csv: expected frame 2 at 1.*, found 1000000\.200000 s"):
        _facts(tmp_path)
    # Without that column poses may be of any times.
    lines = [line.partition(",")[2] for line in layout.poses_path.read_text().splitlines()]
    layout.poses_path.write_text("\n".join(lines))
    assert len(_facts(tmp_path).poses) == FRAMES


def test_a_frame_that_the_table_of_times_lacks_is_not_said_to_lack_a_pose(tmp_path):
    layout = _write(tmp_path, 0.1, 0.1)
    rows = [f"{frame},{0.1 * frame:.6f}" for frame in range(FRAMES) if frame != 2]
    layout.frames_path.write_text("\n".join(["frame,time_s", *rows]))
    write_cameras(layout, {"front": (Pinhole(50.0, 50.0, 32.0, 24.0, 64, 48), np.eye(4))})
    write_plain_image(layout, "front", 0, np.zeros((48, 64, 3), np.uint8))
    drive = read_drive(scene_at(tmp_path, "plain"), lambda line: None)
    assert drive.frames[2].reason == "no pose: its time is not known, frames.csv has no frame 2"
    image = next(one for one in drive.images if one.frame == 1)
    assert image.reason == "no image file images/front/0000000001.png or .jpg"


def test_key_frames_have_the_sweep_that_their_points_times_show(tmp_path):
    _write(tmp_path, 0.5, 0.05)
    facts = _facts(tmp_path)
    assert facts.times.sweep_period_s == pytest.approx(0.05, rel=1e-3)
    assert any(note.startswith("a sweep lasts 0.05 s") for note in facts.notes)


def test_a_given_sweep_that_outlasts_the_step_between_scans_is_refused(tmp_path):
    layout = _write(tmp_path / "bare", 0.05, None)
    words = r"sweep_period_s: expected at most .* 0\.05 s in the median, found 0\.1; correct it, or leave"
    given = {"sweep_period_s": 0.1, "root": layout.root, "kind": "plain"}
    with pytest.raises(DataError, match=words):
        read_drive(scene_at(**given), str)
    with pytest.raises(DataError, match=words):
        import_drive(scene_at(**given), tmp_path / "out", progress=str)
    read_drive(scene_at(**given, compensate=False), str)  # of instants, as our own exports may be
    _write(tmp_path / "stamped", 0.05, 0.1)
    assert read_drive(scene_at(**{**given, "root": tmp_path / "stamped"}), str).times.sweep_period_s == 0.1
    # Every second frame is an image's alone.
    for frame in range(1, FRAMES, 2):
        layout.scan_path(frame).unlink()
    assert read_drive(scene_at(**given), str).times.sweep_period_s == 0.1


@pytest.mark.parametrize("sweep_s", [0.1, 0.1037, None])
def test_scans_that_follow_each_other_last_from_frame_to_frame(tmp_path, sweep_s):
    _write(tmp_path, 0.1037, sweep_s)
    for given_s in (None, 0.1, 0.1037):
        facts = _facts(tmp_path, sweep_period_s=given_s)
        assert facts.times.sweep_period_s == float(np.median(np.diff(facts.times.time_s)))
        assert facts.notes == ()


def test_rings_and_times_may_have_names_of_any_number_of_digits_as_scans_may(tmp_path):
    layout = _write(tmp_path, 0.1, 0.1)
    recorded = drive_of(scene_at(tmp_path, "plain")).read_scan(2)
    for path in [*layout.scans_dir.iterdir(), *layout.beside_dir("time").iterdir()]:
        path.rename(path.with_name(f"{int(path.stem):06d}.bin"))
    found = drive_of(scene_at(tmp_path, "plain"))
    assert np.array_equal(found.read_scan(2).offset_s, recorded.offset_s)
    assert layout.root / "time/000002.bin" in found.section().files


def test_rings_that_are_no_scans_are_refused(tmp_path):
    layout = _write(tmp_path, 0.1, None)
    layout.beside_dir("ring").mkdir()
    _facts(tmp_path)
    (layout.beside_dir("ring") / "scan_0.bin").touch()
    with pytest.raises(DataError, match=r"ring: expected files named .* found 'scan_0\.bin'; rename them"):
        _facts(tmp_path)


def _time_as(layout: PlainLayout, name: str, kind: str, values_of) -> None:
    """Write the scans again as ASCII PCD, with a column of times made of frame and seconds after it."""
    for frame in range(FRAMES):
        path = layout.scan_path(frame)
        rows = np.fromfile(path, "<f4").reshape(-1, 4)
        time = values_of(frame, np.fromfile(layout.beside_path("time", frame), "<f4").astype(np.float64))
        head = (
            f"FIELDS x y z intensity {name}\nSIZE 4 4 4 4 {kind[1]}\nTYPE F F F F {kind[0]}\n"
            f"WIDTH {len(rows)}\nHEIGHT 1\nDATA ascii\n"
        )
        shown = [f"{one:.7f}" if kind[0] == "F" else str(int(one)) for one in time]
        lines = [f"{x} {y} {z} {i} {t}" for (x, y, z, i), t in zip(rows.tolist(), shown, strict=True)]
        layout.scan_path(frame, "pcd").write_text(head + "\n".join(lines) + "\n")
        path.unlink()
        layout.beside_path("time", frame).unlink()


CLOCK_S = 1.7e9
TIMES = {
    "nanoseconds after the begin": ("t", "U4", lambda frame, s: np.maximum(1e9 * (s + 0.05), 0.0), 0.05),
    "a clock's seconds": ("timestamp", "F8", lambda frame, s: CLOCK_S + 0.1 * frame + s, 0.05),
    "a clock's nanoseconds": ("timestamp", "U8", lambda frame, s: 1e9 * (CLOCK_S + 0.1 * frame + s), 0.05),
    "the frames' clock": ("timestamp", "F8", lambda frame, s: 5.0 + 0.1 * frame + s, 0.0),
}


@pytest.mark.parametrize("case", TIMES)
def test_times_of_points_are_read_by_type_and_clock(tmp_path, case):
    layout = _write(tmp_path, 0.1, 0.1, begin_s=5.0)
    recorded = drive_of(scene_at(tmp_path, "plain")).read_scan(2)
    name, kind, values_of, shift_s = TIMES[case]
    _time_as(layout, name, kind, values_of)
    drive = drive_of(scene_at(tmp_path, "plain"))
    assert np.allclose(drive.read_scan(2).offset_s, recorded.offset_s, atol=1e-4)
    assert drive.stamp_shift_s == pytest.approx(shift_s, abs=1e-3)


def test_times_of_a_clock_that_begins_with_the_drive_are_read_alike_in_all_scans(tmp_path):
    layout = _write(tmp_path, 0.1, 0.1)
    recorded = drive_of(scene_at(tmp_path, "plain"))
    offsets_s = [recorded.read_scan(frame).offset_s for frame in range(FRAMES)]
    _time_as(layout, "timestamp", "F8", lambda frame, s: 0.1 * frame + s)
    drive = drive_of(scene_at(tmp_path, "plain"))
    for frame, offset_s in enumerate(offsets_s):
        assert np.allclose(drive.read_scan(frame).offset_s, offset_s, atol=1e-4), frame


@pytest.mark.parametrize(
    ("kind", "values_of"),
    [
        ("F8", lambda frame, s: 1e6 * (s + 0.05)),  # microseconds
        ("F8", lambda frame, s: 100.0 * s),
        ("F4", lambda frame, s: CLOCK_S + s),
    ],
)
def test_times_that_are_no_scans_are_refused_by_file_and_column(tmp_path, kind, values_of):
    layout = _write(tmp_path, 0.1, 0.1)
    _time_as(layout, "t", kind, values_of)
    with pytest.raises(DataError, match=r"0000000001\.pcd: t: expected times of one scan, within 2 s"):
        drive_of(scene_at(tmp_path, "plain")).read_scan(1)


@pytest.mark.parametrize("kind", ["pcd", "ply", "bin"])
def test_rays_without_a_return_in_an_organised_cloud_are_left_out(tmp_path, kind):
    layout = _write(tmp_path, 0.1, 0.1)
    recorded = drive_of(scene_at(tmp_path, "plain")).read_scan(1)
    rows = np.fromfile(layout.scan_path(1), "<f4").reshape(-1, 4)
    rows[::3, :3] = np.nan
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "intensity"))
    head = {
        "pcd": "FIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nWIDTH 100\nHEIGHT 6\nDATA binary\n",
        "ply": f"ply\nformat binary_little_endian 1.0\nelement vertex {POINTS}\n{names}end_header\n",
        "bin": "",
    }[kind]
    layout.scan_path(1).unlink()
    layout.scan_path(1, kind).write_bytes(head.encode() + rows.tobytes())
    scan = drive_of(scene_at(tmp_path, "plain")).read_scan(1)
    kept = np.arange(POINTS) % 3 > 0
    assert np.array_equal(scan.points, recorded.points[kept]) and scan.n_absurd == 0
    assert np.array_equal(scan.offset_s, recorded.offset_s[kept])


def test_intensities_of_another_scale_say_which_key_mends_it(tmp_path):
    layout = _write(tmp_path, 0.1, None)
    rows = np.fromfile(layout.scan_path(0), "<f4").reshape(-1, 4)
    rows[:, 3] = np.linspace(0.0, 255.0, POINTS)
    layout.scan_path(0).write_bytes(rows.tobytes())
    with pytest.raises(DataError, match=r"0 to 1, found up to 255; set intensity_max in drive\.json"):
        drive_of(scene_at(tmp_path, "plain")).read_scan(0)
    layout.drive_path.write_text('{"intensity_max": 255}')
    assert drive_of(scene_at(tmp_path, "plain")).read_scan(0).points[:, 3].max() == 1.0


def _add_images(layout: PlainLayout) -> None:
    write_cameras(layout, {"left": (Pinhole(50.0, 50.0, 32.0, 24.0, 64, 48), np.eye(4))})
    rgb = np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8)
    for frame in range(FRAMES):
        write_plain_image(layout, "left", frame, rgb)


def _stamp_the_begin(layout: PlainLayout) -> None:
    for frame in range(FRAMES):
        path = layout.beside_path("time", frame)
        (np.fromfile(path, "<f4") + np.float32(0.05)).tofile(path)


@pytest.mark.parametrize("is_begin", [False, True])
def test_images_without_times_are_of_their_frames_recorded_time(tmp_path, is_begin):
    layout = _write(tmp_path, 0.1, 0.1)
    _add_images(layout)
    if is_begin:
        _stamp_the_begin(layout)
    scene = scene_at(tmp_path, "plain", cameras=("left",), first_frame=1, last_frame=2)
    drive = drive_of(scene)
    pose = drive.facts().poses[1]
    assert pose[0, 3] == pytest.approx(1.5 if is_begin else 1.0, abs=0.01)  # the middle of the sweep
    assert drive.pose_at_image("left", 1, pose)[0, 3] == pytest.approx(1.0)
    delay_s = drive.image_delay_s("left", 1)
    assert delay_s == pytest.approx(-0.05, abs=1e-3) if is_begin else delay_s is None


def test_an_image_that_its_cameras_times_do_not_name_is_left_out(tmp_path):
    layout = _write(tmp_path, 0.1, 0.1)
    _add_images(layout)
    write_image_times(layout, "left", {0: 0.01, 2: 0.21, 3: 0.31})
    layout.images_dir("left").joinpath("0000000003.png").unlink()
    rows = read_drive(scene_at(tmp_path, "plain", cameras=("left",)), lambda _: None).images
    assert [row.image_valid for row in rows] == [True, False, True, False]
    assert "times.csv: expected the time of 0000000001.png, found none of frame 1" in rows[1].reason
    assert "no image file" in rows[3].reason


def test_boxes_of_frames_that_the_drive_has_not_are_named_and_those_of_other_sections_are_not(tmp_path):
    layout = _write(tmp_path, 0.1, None)
    rows = [f"{frame},7,car,1,10,2,0,0,0,0,1,4,2,1.5" for frame in (1, FRAMES - 1, 1001)]
    head = "frame,object_id,label,dynamic,x,y,z,qx,qy,qz,qw,length,width,height"
    layout.boxes_path.write_text("\n".join([head, *rows]))
    found = drive_of(scene_at(tmp_path, "plain", last_frame=FRAMES - 2)).boxes()
    assert [box.frame for box in found.boxes] == [1]
    assert found.left_out == (
        f"line 4 of boxes.csv: frame: expected -1, or one of the drive's, 0 to {FRAMES - 1}, found 1001",
    )
    # The table of poses says so, too.
    for frame in range(FRAMES):
        layout.scan_path(frame).unlink()
    assert drive_of(scene_at(tmp_path, "plain")).boxes().left_out == found.left_out
