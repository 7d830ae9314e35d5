"""The examples run, one after the other, on the tiny drive; one writes a drive of its own, which is read."""

import runpy
import sys
from pathlib import Path

import pytest

from nvsf_core.drives.catalogue import load_catalogue
from nvsf_core.stages import plan_run, run_named_stage
from nvsf_core.stages.inputs import read_sweeps

REPO = Path(__file__).resolve().parents[2]


@pytest.fixture
def run(tiny_catalogue, tmp_path, monkeypatch, capsys):
    """Run an example as its command does, in this process: one of its own would load everything anew."""
    monkeypatch.setenv("NVSF_SCENES", str(tiny_catalogue))
    monkeypatch.setenv("NVSF_HOME", str(tmp_path / "examples"))

    def example(name: str, *words: str) -> str:
        monkeypatch.setattr(sys, "argv", [f"{name}.py", *words])
        runpy.run_path(str(REPO / f"examples/{name}.py"), run_name="__main__")
        return capsys.readouterr().out

    return example


def test_the_examples_run_in_their_order(run, tmp_path):
    assert "dataset: " in run("one_scene", "tiny", "smoke")
    made = tmp_path / "left"
    assert "1.5 m to the left" in run("own_view", "tiny", "smoke", "1.5", str(made))
    (cloud,) = (made / "velodyne_points/ply").iterdir()
    assert cloud.stat().st_size > 200
    said = run("read_metrics", "tiny", "smoke", "lidar4d_scan")
    assert "chamfer_m2" in said and "reproject" in said and "copy_nearest" in said
    for recipe, protocol, words in (
        ("smoke", "nosuch", r"protocol .* lidar4d, lidar4d_scan.*; found 'nosuch'"),
        ("quick", "lidar4d", r"expected .*quick.*, found .*recipes: smoke; train it first"),
    ):
        with pytest.raises(SystemExit, match=words):
            run("read_metrics", "tiny", recipe, protocol)


def test_the_drive_of_plain_files_is_read_its_lasers_are_found_and_its_checks_hold(run, tmp_path):
    run("plain_drive", str(tmp_path / "mine"))
    (scene,) = load_catalogue([tmp_path / "mine/scenes.toml"], None)
    done = plan_run(scene, tmp_path / "home", recipe="smoke")
    for stage in ("frames", "sweeps", "pano", "undistorted", "evidence"):
        made = run_named_stage(stage, done, lambda line: None)
        # A corridor of plain walls is at every place the same: its scans would fit any pose.
        assert [check.name for check in made.checks if not check.passed] == []
    sweeps = read_sweeps(done.store)
    assert sweeps.table.name == "found-32" and len(sweeps.arrays["frame"]) == 12
    assert (sweeps.arrays["laser"] >= 0).all() and (sweeps.arrays["firings"] == 720).all()


@pytest.mark.parametrize("path", sorted((REPO / "examples").glob("*.py")), ids=lambda path: path.stem)
def test_an_example_is_at_most_40_lines(path):
    assert len(path.read_text().splitlines()) <= 40
