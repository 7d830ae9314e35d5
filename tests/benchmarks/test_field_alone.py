"""The paper's field gets the time that `lean` had, at the size that left-out frames chose."""

import json
from pathlib import Path
from statistics import fmean

import pytest

from benchmarks.lean.field_alone import equally_long
from benchmarks.speed_error.plan import RESULTS, OneRun
from benchmarks.speed_error.sizes import chosen_size
from benchmarks.tables.results_table import RECIPES, ROOT, measured_rows
from nvsf_core.errors import DataError

SCENE = "k360_street"


def _lean(folder: Path, *seconds: float) -> Path:
    rows = [{"scene": SCENE, "train_seconds": one} for one in seconds]
    (folder / "lean.json").write_text(json.dumps({"rows": [*rows, {"scene": "other", "train_seconds": 1e9}]}))
    return folder


def test_the_best_size_gets_as_many_steps_as_fit_into_the_mean_of_leans_seconds(tmp_path):
    curve = json.loads(OneRun(SCENE, "full", "paper_cpu", 0).path(RESULTS).read_text())
    seconds_a_step = curve["run"]["training"]["seconds_a_step"]
    found = equally_long(RESULTS, _lean(tmp_path, 100.0, 300.0), SCENE)
    assert found.optimiser.steps == round(200.0 / seconds_a_step)
    best = chosen_size(RESULTS, SCENE, 0)
    assert (found.name, found.encoder, found.sampling) == ("paper_cpu", best.encoder, best.sampling)
    rows = measured_rows(ROOT / RECIPES / "lean.json")
    lean_s = fmean(row["train_seconds"] for row in rows if row["scene"] == SCENE)
    assert equally_long(RESULTS, ROOT / RECIPES, SCENE).optimiser.steps == round(lean_s / seconds_a_step)


@pytest.mark.parametrize("scene", [SCENE, "nowhere"])
def test_what_was_not_measured_is_named_beside_the_command_that_measures_it(tmp_path, scene):
    with pytest.raises(DataError, match=f"SCENES={scene} make bench"):
        equally_long(RESULTS, tmp_path, scene)
