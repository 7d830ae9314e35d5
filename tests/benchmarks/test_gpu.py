"""What a GPU would be measured by runs through on the CPU, and its page invents no figure."""

import json

from benchmarks.gpu.document import PARTS, page


def test_every_part_runs_tiny_on_this_machine_and_stands_on_the_page(run_process, tmp_path):
    done = run_process("python", "-m", "benchmarks.gpu", "--smoke", "--to", str(tmp_path))
    assert done.returncode == 0, done.stderr
    measured = json.loads((tmp_path / "gpu.json").read_text())
    assert list(measured) == list(PARTS)
    (tests,) = measured["tests"][""]["rows"]
    assert tests["passed"] > 0 and tests["failed"] == []
    for row in measured["kernels"][""]["rows"]:
        assert row["relative_error"] < 1e-5 and row["ms"] > row["least_ms"] > 0.0
    steps = measured["steps"]["tiny"]["rows"]
    # How many rays are held at once is a matter of memory, not of the result.
    assert len(steps) == 2 and abs(steps[0]["loss"] - steps[1]["loss"]) < 1e-3 * steps[0]["loss"]
    methods = [row["method"] for row in measured["training"]["tiny"]["rows"]]
    assert methods == ["smoke", "paper_smoke", "copy_nearest", "reproject"]
    text = (tmp_path / "gpu.md").read_text()
    assert text == page(measured) and "Not run on a GPU." not in text


def test_a_part_without_figures_says_that_it_was_not_run():
    assert page({}).count("Not run on a GPU.") == len(PARTS)


def test_the_committed_page_is_what_its_figures_give(repo):
    results = repo / "benchmarks/results/gpu.json"
    measured = json.loads(results.read_text()) if results.is_file() else {}
    assert (repo / "docs/gpu.md").read_text() == page(measured)
