"""A large scan that is imported is read again; one too large is left out before anything of it is written."""

from pathlib import Path

import numpy as np

from nvsf_core.drives.detect import whole_drive
from nvsf_core.drives.drive import drive_of
from nvsf_core.drives.kitti360.scans import MOST_RETURNS
from nvsf_core.drives.plain.layout import PlainLayout
from nvsf_core.drives.plain.writer import write_poses
from nvsf_core.stages.imports.convert import import_drive

TWO_RETURNS_OF_AN_OS1_128 = 2 * 128 * 2048


def _write_ply(path: Path, returns: int) -> None:
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {returns}\n"
    head += "".join(f"property float {name}\n" for name in ("x", "y", "z", "intensity")) + "end_header\n"
    angle = np.linspace(0.0, 2.0 * np.pi, returns)
    rows = np.stack([9.0 * np.cos(angle), 9.0 * np.sin(angle), 0.0 * angle, 0.5 + 0.0 * angle], axis=1)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(head.encode() + rows.astype("<f4").tobytes())


def test_a_large_scan_is_read_again_and_one_too_large_is_left_out(tmp_path: Path) -> None:
    layout = PlainLayout(tmp_path / "in")
    write_poses(layout, range(3), [0.0, 0.1, 0.2], [np.eye(4)] * 3)
    counts = [2000, TWO_RETURNS_OF_AN_OS1_128, MOST_RETURNS + 1]
    for frame, count in enumerate(counts):
        _write_ply(layout.scan_path(frame, "ply"), count)
    done = import_drive(whole_drive(layout.root, "plain"), tmp_path / "out", progress=str)
    (words,) = done.left_out
    assert words.startswith("scan 2: ") and "0000000002.ply" in words
    assert f"at most {MOST_RETURNS:,} returns" in words and f"found {MOST_RETURNS + 1:,}" in words
    written = drive_of(whole_drive(tmp_path / "out", "plain"))
    assert [len(written.read_scan(frame).points) for frame in (0, 1)] == counts[:2]
    assert not PlainLayout(tmp_path / "out").scan_path(2).exists()
