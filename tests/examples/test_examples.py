"""The three examples run, one after the other, on the tiny drive."""

import sys
from pathlib import Path

import pytest

REPO = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def run(tiny_catalogue, tmp_path_factory, run_process):
    places = {"NVSF_SCENES": str(tiny_catalogue), "NVSF_HOME": str(tmp_path_factory.mktemp("examples"))}

    def example(name: str, *words: str) -> str:
        done = run_process(sys.executable, f"examples/{name}.py", *words, PYTHONPATH=str(REPO), **places)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    return example


def test_the_examples_run_in_their_order(run, tmp_path):
    assert "dataset: " in run("one_scene", "tiny", "smoke")
    made = tmp_path / "left"
    assert "1.5 m to the left" in run("own_view", "tiny", "smoke", "1.5", str(made))
    (cloud,) = (made / "velodyne_points/ply").iterdir()
    assert cloud.stat().st_size > 200
    said = run("read_metrics", "tiny", "smoke", "lidar4d_scan")
    assert "chamfer_m2" in said and "reproject" in said and "copy_nearest" in said


@pytest.mark.parametrize("path", sorted((REPO / "examples").glob("*.py")), ids=lambda path: path.stem)
def test_an_example_is_at_most_40_lines(path):
    assert len(path.read_text().splitlines()) <= 40
