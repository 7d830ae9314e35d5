"""The results are what was measured, and only what was measured again is replaced."""

import json
import sys
from pathlib import Path

from benchmarks.results_table import BEGIN, END, as_markdown, write

sys.path.insert(0, str(Path(__file__).parents[1] / "reporting"))
from street_store import write_street  # tests are no package


def _root(folder: Path) -> Path:
    (folder / "benchmarks" / "results" / "recipes").mkdir(parents=True)
    (folder / "README.md").write_text(f"above\n{BEGIN}old table\n{END}below\n")
    return folder


def _rows(root: Path, recipe: str) -> list[dict]:
    return json.loads((root / "benchmarks" / "results" / "recipes" / f"{recipe}.json").read_text())["rows"]


def test_each_recipe_has_a_file_with_a_row_a_scene_method_and_seed(tmp_path):
    root, home = _root(tmp_path / "checkout"), tmp_path / "home"
    write_street(home, "street", seed=0)
    write_street(home, "street", seed=1)
    write_street(home, "avenue", recipe="smoke")
    write(home, root)
    found = [(row["scene"], row["seed"], row["method"]) for row in _rows(root, "quick")]
    methods = ("quick", "reproject", "copy_nearest", "mesh")
    assert found == [("street", seed, method) for seed in (0, 1) for method in methods]
    assert {row["scene"] for row in _rows(root, "smoke")} == {"avenue"}
    first = _rows(root, "quick")[0]
    assert (first["chamfer_m2"], first["f_score"], first["commit"]) == (0.03, 0.97, "abc")


def test_what_another_home_measured_stays_and_what_was_measured_again_is_replaced(tmp_path):
    root = _root(tmp_path / "checkout")
    write_street(tmp_path / "one", "street")
    write(tmp_path / "one", root)
    target = root / "benchmarks" / "results" / "recipes" / "quick.json"
    target.write_text(target.read_text().replace("0.03,", "9.0,"))
    write_street(tmp_path / "two", "avenue")
    write(tmp_path / "two", root)
    assert [row["chamfer_m2"] for row in _rows(root, "quick") if row["method"] == "quick"] == [0.03, 9.0]
    write(tmp_path / "one", root)
    assert [row["chamfer_m2"] for row in _rows(root, "quick") if row["method"] == "quick"] == [0.03, 0.03]


def test_the_readme_holds_the_table_between_its_marks_and_nothing_else_changes(tmp_path):
    root = _root(tmp_path / "checkout")
    write_street(tmp_path / "home", "street")
    table = write(tmp_path / "home", root)
    readme = (root / "README.md").read_text()
    assert readme.startswith(f"above\n{BEGIN}") and readme.endswith(f"{END}below\n")
    assert table in readme and "old table" not in readme
    assert "| `street` | `quick` | 1 | 0.030 | 0.970 |" in table
    assert "| `street` | `reproject` |  | 0.060 |" in table
    assert "| `street` | `mesh` |  | 0.090 |" in table


def test_seeds_are_shown_as_mean_and_spread_and_a_baseline_once(tmp_path):
    write_street(tmp_path / "home", "street")
    root = _root(tmp_path / "checkout")
    write(tmp_path / "home", root)
    rows = _rows(root, "quick")
    again = [row | {"seed": 1, "chamfer_m2": row["chamfer_m2"] + 0.02} for row in rows]
    table = as_markdown([*rows, *again])
    assert "| `street` | `quick` | 2 | 0.040 ± 0.014 |" in table
    assert table.count("`copy_nearest`") == 1 and "± 0.000" in table
