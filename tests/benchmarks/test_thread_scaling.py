"""The page on threads has a row of each trained part, with its times and whether the bits are the same."""

import sys

from benchmarks.lean import threads
from nvsf_core.recipe.presets import preset
from nvsf_core.thread_count import VARIABLE
from tests.stages.lidar_drive import proven_drive


def test_each_part_is_timed_with_each_number_of_threads(tmp_path, monkeypatch):
    run = proven_drive(tmp_path / "run", preset("smoke"), firings=300, held_out=(4,))
    page = tmp_path / "threads.md"
    monkeypatch.setenv(VARIABLE, "1")
    given = ["proven", "--home", str(run.store.home), "--recipe", "smoke", "--threads", "1", "2"]
    monkeypatch.setattr(sys, "argv", ["threads", *given, "--out", str(page)])
    threads.main()
    rows = [line.split("|")[1:-1] for line in page.read_text().splitlines() if line.endswith("| yes |")]
    assert [row[0].strip() for row in rows] == ["LiDAR field", "network of hits"]
    assert all(float(cell) > 0.0 for row in rows for cell in row[1:4])
    assert "NO" not in page.read_text()
