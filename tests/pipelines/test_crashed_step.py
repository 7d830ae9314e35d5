"""A step whose process dies fails its scene alone."""

import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.cli
SCENE = """
[[scene]]
name = "{name}"
root = "{root}"
sequence = "2013_05_28_drive_9900_sync"
first_frame = 0
last_frame = {last}
test_frames = [1]
"""


def test_a_crashed_process_fails_its_scene_alone_and_the_report_is_made(
    run_process, tiny_catalogue, tmp_path
):
    drive = tiny_catalogue.parent / "drive"
    scenes = tmp_path / "scenes.toml"
    # The longer scene, which crashes, comes first.
    scenes.write_text(
        SCENE.format(name="good", root=drive, last=2) + SCENE.format(name="bad", root=drive, last=3)
    )
    (tmp_path / "dagster").mkdir()
    done = run_process(
        sys.executable, str(Path(__file__).with_name("crashing_flow.py")), NVSF_SCENES=str(scenes),
        NVSF_HOME=str(tmp_path / "home"), DAGSTER_HOME=str(tmp_path / "dagster"), PYTHONPATH=".",
    )  # fmt: skip
    said = done.stdout + done.stderr
    assert done.returncode == 1, said
    assert "FAILED  bad: frames: its process died twice" in said
    assert "good: " in said and (tmp_path / "home/benchmark_report/index.html").is_file()
    assert (tmp_path / "home/good/scene_metrics/lean/0/metrics.parquet").is_file()
