"""``make bench``: speed against error, then every metric of the recipes that learn a residual.

First the runs of `benchmarks.speed_error.curves`, which train. Then, of whole scenes, Dagster's job
``benchmark`` for each recipe and seed: its stage ``field`` goes on from the finished checkpoint that the
curve's run left, so that nothing is trained twice; the metrics over all rays and pixels, the report and
README's table follow. What is up to date is not repeated. SCENES, RECIPES, SEEDS, SPLITS, MARKS say what is
measured.
"""

import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

from benchmarks.common.documents import ROOT
from benchmarks.speed_error.curves import Asked, asked_from, measure
from benchmarks.speed_error.document import write_document
from benchmarks.speed_error.plan import FULL, RESULTS
from benchmarks.tables.results_table import write
from nvsf_core.drives.catalogue import home_from_environment
from nvsf_core.recipe.paper import PaperRecipe
from nvsf_core.recipe.presets import preset


def main() -> int:
    """Exit code of the worst run; the results of the others are written all the same."""
    asked = asked_from(os.environ)
    failed = measure(asked)
    print(write_document(RESULTS))
    worst = _measure_whole(asked) if FULL in asked.splits else 0
    print(write(home_from_environment(os.environ), ROOT))
    for reason in failed:
        print(f"FAILED  {reason}")
    return max(worst, 1 if failed else 0)


def _measure_whole(asked: Asked) -> int:
    """The job ``benchmark``, one recipe and one seed a run, like every run of this project."""
    worst = 0
    for recipe in asked.recipes:
        # A curve trains the paper's family for a fixed time, which is no preset; `make train` measures these.
        for seed in () if isinstance(preset(recipe), PaperRecipe) else asked.seeds:
            print(f"benchmark: {recipe}, seed {seed}", flush=True)
            chosen = {"SCENES": " ".join(asked.scenes), "RECIPE": recipe, "SEED": str(seed)}
            worst = max(worst, execute_benchmark(chosen))
    return worst


def execute_benchmark(chosen: Mapping[str, str]) -> int:
    """Run the job as a user starts it, with variables (SCENES, RECIPE, ...) over our own; its exit code."""
    dagster = Path(sys.executable).parent / "dagster"
    environment = os.environ | {"DAGSTER_MODULE_NAME": "pipelines.definitions"} | chosen
    done = subprocess.run([dagster, "job", "execute", "-j", "benchmark"], env=environment, check=False)
    return abs(done.returncode)


if __name__ == "__main__":
    sys.exit(main())
