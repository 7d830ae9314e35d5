"""A drive without poses gets them from its scans, with their quality in words."""

import json
import sys

import numpy as np
import pytest

from nvsf_core.drives.detect import whole_drive
from nvsf_core.drives.drive import drive_of
from nvsf_core.drives.kitti360.scans import Scan
from nvsf_core.drives.plain.layout import PlainLayout
from nvsf_core.drives.plain.writer import write_plain_scan
from nvsf_core.errors import MissingLibraryError
from nvsf_core.stages.imports.convert import import_drive

FRAMES, STEP_M = 10, 0.8


def _corridor(x_m: float, frame: int) -> Scan:
    """Walls, a road and posts, seen from a place on the way; points are of one instant."""
    rng = np.random.default_rng(frame)
    place = np.stack(
        [rng.uniform(-30, 60, 9000), rng.uniform(-8, 8, 9000), rng.uniform(-1.7, 4, 9000)], axis=1
    )
    side = rng.integers(0, 3, 9000)
    place[side == 0, 1] = np.sign(place[side == 0, 1]) * 8.0
    place[side == 1, 2] = -1.7
    post = side == 2
    place[post, 0], place[post, 1] = np.round(place[post, 0] / 6.0) * 6.0, np.sign(place[post, 1]) * 5.0
    points = np.column_stack([place - [x_m, 0.0, 0.0], np.full(9000, 0.5)]).astype(np.float32)
    return Scan(points, 0, offset_s=np.zeros(9000))


@pytest.fixture(scope="module")
def bare(tmp_path_factory):
    root = tmp_path_factory.mktemp("bare")
    for frame in range(FRAMES):
        write_plain_scan(PlainLayout(root), frame, _corridor(STEP_M * frame, frame))
    return root


def test_a_path_is_found_also_where_the_sensor_drives_from_the_start(bare, tmp_path):
    pytest.importorskip("kiss_icp", reason="the extra `odometry` is not installed")
    scene = whole_drive(bare, "plain")
    done = import_drive(scene, tmp_path / "out", progress=lambda line: None)
    assert done.frames == done.scans == FRAMES
    assert any(note.startswith(f"poses found from {FRAMES} scans by KISS-ICP") for note in done.notes)
    assert json.loads((tmp_path / "out/import.json").read_text())["notes"] == list(done.notes)
    poses = drive_of(whole_drive(tmp_path / "out", "plain")).facts().poses
    steps_m = np.diff([poses[frame][0, 3] for frame in range(FRAMES)])
    assert np.abs(steps_m - STEP_M).max() < 0.15
    assert abs(steps_m.sum() - STEP_M * (FRAMES - 1)) < 0.15


def test_without_kiss_icp_the_command_that_installs_it_is_said(bare, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "kiss_icp.config", None)
    with pytest.raises(MissingLibraryError, match=r"pip install 'nvsf\[odometry\]'"):
        import_drive(whole_drive(bare, "plain"), tmp_path / "out", progress=lambda line: None)
    assert not (tmp_path / "out").exists()
