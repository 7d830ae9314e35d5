"""A drive imported as plain files keeps its path between frames."""

import json
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nvsf_core.demo.drive import DemoSize, write_demo
from nvsf_core.drives.catalogue import load_catalogue
from nvsf_core.drives.detect import whole_drive
from nvsf_core.drives.drive import drive_of
from nvsf_core.drives.entries import SceneEntry
from nvsf_core.drives.kitti360.scans import Scan
from nvsf_core.drives.plain.layout import PlainLayout
from nvsf_core.drives.plain.writer import (
    write_cameras,
    write_description,
    write_frame_times,
    write_image_times,
    write_plain_image,
    write_plain_scan,
    write_poses,
)
from nvsf_core.drives.validation import read_drive
from nvsf_core.errors import DataError
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.geometry.se3 import pose_of_angles
from nvsf_core.stages.imports.convert import import_drive
from tests.stages.exports.small_data_set import LEVEL

FRAMES, STEP_S, DELAY_S, BEGIN_S = 8, 0.1, 0.045, 37.2
CAMERA = Pinhole(fx=20.0, fy=20.0, cx=15.5, cy=11.5, width=32, height=24)


def _place(time_s: float) -> np.ndarray:
    """10 m/s ahead, pitching by a degree twice a second."""
    return pose_of_angles((10.0 * time_s, 0.0, 1.8), 0.0, float(np.sin(4.0 * np.pi * time_s)), 0.0)


def _write(root: Path, path_s: np.ndarray, frames: range | None, points_s: np.ndarray | None) -> SceneEntry:
    """A drive whose images are later than its scans, at poses of these times."""
    layout = PlainLayout(root)
    write_description(layout, "VLP-16")
    write_poses(layout, frames, path_s.tolist(), [_place(one) for one in path_s])
    moments_s = {frame: BEGIN_S + STEP_S * frame for frame in range(FRAMES)}
    write_frame_times(layout, moments_s)
    write_cameras(layout, {"front": (CAMERA, LEVEL)})
    write_image_times(layout, "front", {frame: one + DELAY_S for frame, one in moments_s.items()})
    angle = np.linspace(np.pi, -np.pi, 200, endpoint=False)
    rows = np.stack([9.0 * np.cos(angle), 9.0 * np.sin(angle), 0.0 * angle, 0.5 + 0.0 * angle], axis=1)
    for frame in range(FRAMES):
        write_plain_scan(layout, frame, Scan(rows.astype(np.float32), 0, offset_s=points_s))
        write_plain_image(layout, "front", frame, np.arange(24 * 32 * 3, dtype=np.uint8).reshape(24, 32, 3))
    return whole_drive(root, "plain", first=2, last=FRAMES - 1)


@pytest.mark.parametrize("points_s", [None, np.linspace(0.0, STEP_S, 200)], ids=["bare", "stamped at begin"])
def test_images_between_frames_are_where_the_whole_path_says(tmp_path, points_s):
    # The path ends 2 ms before the last image.
    path_s = BEGIN_S + STEP_S * (FRAMES - 1) + DELAY_S - 0.002 - np.arange(100)[::-1] * 0.01
    scene = _write(tmp_path / "in", path_s, None, points_s)
    done = import_drive(scene, tmp_path / "out", progress=lambda line: None)
    recorded, found = drive_of(scene), drive_of(whole_drive(tmp_path / "out", "plain"))
    poses, again = recorded.facts().poses, found.facts().poses
    assert done.left_out == () and sorted(again) == sorted(poses) == list(range(2, FRAMES))
    for frame, pose in poses.items():
        assert np.allclose(again[frame], pose, atol=1e-9)
        between = recorded.pose_at_image("front", frame, pose)
        assert np.allclose(found.pose_at_image("front", frame, again[frame]), between, atol=1e-9)


def test_a_path_of_frames_alone_says_of_which_each_pose_is(tmp_path):
    path_s = BEGIN_S + STEP_S * np.arange(FRAMES)
    import_drive(
        _write(tmp_path / "in", path_s, range(FRAMES), None), tmp_path / "out", progress=lambda line: None
    )
    rows = (tmp_path / "out/poses.csv").read_text().splitlines()
    assert rows[0].startswith("frame,time_s,") and len(rows) == 1 + FRAMES - 2


@pytest.mark.parametrize(
    ("last", "test", "words"),
    [(7, (4,), "one is held out for measuring: 4"), (4, (3,), "one is held out for measuring: 3"),
     (3, (), "too few frames to hold one out")],
)  # fmt: skip
def test_of_a_short_drive_the_middle_frame_is_held_out_and_said(tmp_path, last, test, words):
    path_s = BEGIN_S + STEP_S * np.arange(FRAMES)
    scene = replace(_write(tmp_path / "in", path_s, range(FRAMES), None), last_frame=last)
    done = import_drive(scene, tmp_path / "out", progress=lambda line: None)
    (entry,) = load_catalogue([tmp_path / "out/scenes.toml"], None)
    assert entry.test_frames == test and any(words in note for note in done.notes), done.notes


@pytest.mark.parametrize("layout", ["plain", "kitti360"])
def test_assumed_times_stay_assumed_and_a_given_sweep_spaces_them(tmp_path, layout):
    write_demo(tmp_path / "in", size=DemoSize.tiny())
    for path in (tmp_path / "in").glob("data_*/**/timestamps*.txt"):
        path.unlink()
    scene = replace(whole_drive(tmp_path / "in", "kitti360"), sweep_period_s=0.05)
    assert drive_of(scene).times().is_assumed
    done = import_drive(scene, tmp_path / "out", layout=layout, progress=lambda line: None)
    assert "times: assumed 0.05 s a frame: no timestamp file" in done.notes
    (entry,) = load_catalogue([tmp_path / "out/scenes.toml"], None)
    times = drive_of(entry).times()
    assert times.is_assumed and times.source == "assumed 0.05 s a frame: no timestamp file"
    assert times.sweep_period_s == 0.05 and np.allclose(np.diff(times.time_s), 0.05)


def test_recorded_times_are_not_assumed_after_an_import(tmp_path):
    path_s = BEGIN_S + STEP_S * np.arange(FRAMES)
    scene = _write(tmp_path / "in", path_s, range(FRAMES), None)
    import_drive(scene, tmp_path / "out", progress=lambda line: None)
    assert not drive_of(whole_drive(tmp_path / "out", "plain")).times().is_assumed


def test_a_drive_none_of_whose_scans_can_be_used_is_refused_with_the_first_reason(tmp_path):
    path_s = BEGIN_S + STEP_S * np.arange(FRAMES)
    scene = _write(tmp_path / "in", path_s, range(FRAMES), None)
    for path in PlainLayout(tmp_path / "in").scans_dir.iterdir():
        rows = np.fromfile(path, "<f4").reshape(-1, 4)
        (rows * np.float32([1, 1, 1, 255])).tofile(path)
    with pytest.raises(DataError, match=r"found none: scan 2: .*bin: expected intensities 0 to 1"):
        import_drive(scene, tmp_path / "out", progress=lambda line: None)
    assert not (tmp_path / "out").exists()
    # One of them is enough; and a section that has no scan at all is one of cameras.
    write_plain_scan(PlainLayout(tmp_path / "in"), 5, Scan(np.full((9, 4), 0.5, np.float32), 0))
    assert import_drive(scene, tmp_path / "one", progress=lambda line: None).scans == 1
    only = replace(scene, first_frame=6, last_frame=6)
    PlainLayout(tmp_path / "in").scan_path(6).unlink()
    assert import_drive(only, tmp_path / "none", progress=lambda line: None).images == 1


@pytest.mark.parametrize("brightest", [0.5, 0.03, 0.5 / 255, 0.0])
def test_intensities_of_a_smaller_scale_are_noted_by_the_import_and_by_the_drive(tmp_path, brightest):
    path_s = BEGIN_S + STEP_S * np.arange(FRAMES)
    scene = _write(tmp_path / "in", path_s, range(FRAMES), None)
    for path in PlainLayout(tmp_path / "in").scans_dir.iterdir():
        rows = np.fromfile(path, "<f4").reshape(-1, 4)
        rows[:, 3] = np.linspace(0.0, 255.0 * brightest, len(rows))
        rows.tofile(path)
    (tmp_path / "in/drive.json").write_text('{"lidar": "VLP-16", "intensity_max": 255}')
    done = import_drive(scene, tmp_path / "out", progress=lambda line: None)
    (imported,) = load_catalogue([tmp_path / "out/scenes.toml"], None)
    words = "the brightest return of all scans has an intensity of 0.002, expected 0.02 to 1"
    expected = [words] if brightest == 0.5 / 255 else []
    for notes in (done.notes, *(read_drive(one, str).notes for one in (scene, imported))):
        assert [note.partition(":")[0] for note in notes if "brightest" in note] == expected


def _on_clock(root: Path, begin_s: float, points_s: np.ndarray | None) -> SceneEntry:
    """A drive without times of its images, whose first frame is of that second of a clock."""
    path_s = STEP_S * np.arange(FRAMES)
    scene, layout = _write(root, path_s, range(FRAMES), points_s), PlainLayout(root)
    write_poses(layout, range(FRAMES), (begin_s + path_s).tolist(), [_place(one) for one in path_s])
    layout.frames_path.unlink()
    layout.image_times_path("front").unlink()
    return scene


CLOCKS = {"of 1970": (1.75e9, 1.75e9), "of its own": (37.2, None)}


@pytest.mark.parametrize("clock", CLOCKS)
@pytest.mark.parametrize("layout", ["plain", "kitti360"])
def test_the_date_of_a_recording_is_kept(tmp_path, layout, clock):
    begin_s, zero_s = CLOCKS[clock]
    scene = _on_clock(tmp_path / "in", begin_s, None)
    import_drive(scene, tmp_path / "out", layout=layout, progress=lambda line: None)
    (entry,) = load_catalogue([tmp_path / "out/scenes.toml"], None)
    expected = None if zero_s is None else pytest.approx(zero_s + 2 * STEP_S, abs=1e-5)
    assert json.loads((tmp_path / "out/import.json").read_text())["clock_origin_s"] == expected
    assert drive_of(entry).facts().times.origin_s == expected
    later = drive_of(replace(entry, first_frame=4, test_frames=(5,))).facts().times.origin_s
    assert later == (None if zero_s is None else pytest.approx(zero_s + 4 * STEP_S, abs=1e-5))


def test_the_clock_counts_to_the_instant_of_the_first_frame(tmp_path):
    scene = _on_clock(tmp_path / "in", 1.75e9, np.linspace(0.0, STEP_S, 200))
    import_drive(scene, tmp_path / "out", progress=lambda line: None)
    found = drive_of(whole_drive(tmp_path / "out", "plain"))
    # Stamped at the begin, whose middle is half a sweep later.
    assert found.facts().times.origin_s == pytest.approx(1.75e9 + 2.5 * STEP_S, abs=1e-3)


_KILLED = """
import os, signal, sys
from pathlib import Path
from nvsf_core.drives.detect import whole_drive
from nvsf_core.stages.imports.convert import import_drive
scene = whole_drive(Path(sys.argv[1]), "plain")
import_drive(scene, Path(sys.argv[2]), progress=lambda line: os.kill(os.getpid(), signal.SIGKILL))
"""


@pytest.mark.parametrize("is_there", [False, True], ids=["a new folder", "an empty folder"])
def test_what_a_killed_import_left_is_removed_by_the_next(tmp_path, is_there):
    path_s = BEGIN_S + STEP_S * np.arange(FRAMES)
    scene = _write(tmp_path / "in", path_s, range(FRAMES), None)
    out = tmp_path / "drives/out"
    if is_there:
        out.mkdir(parents=True)
    done = subprocess.run([sys.executable, "-c", _KILLED, tmp_path / "in", out], check=False)
    assert done.returncode == -signal.SIGKILL and list(tmp_path.rglob(".publishing-*"))
    import_drive(scene, out, progress=lambda line: None)
    assert list(tmp_path.rglob(".publishing-*")) == [] and (out / "poses.csv").is_file()
