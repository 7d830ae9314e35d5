"""Errors of the paper's field alone, trained for as long as `lean`.

``python -m benchmarks.lean.field_alone`` takes, for each of SCENES (default: k360_street), the size of
`paper_cpu` that was the best on left-out frames, gives it the seconds that `lean` took there on the mean,
renders and scores every held-out frame, and brings the results up to date. It reads what ``make bench``
left: the sizes, the curve and `lean`.
"""

import os
import statistics
from pathlib import Path

from benchmarks.common.documents import ROOT
from benchmarks.speed_error.curves import SCENE
from benchmarks.speed_error.plan import FULL, RESULTS, OneRun, read_result
from benchmarks.speed_error.sizes import NAME, chosen_size, timed
from benchmarks.tables.results_table import RECIPES, measured_rows, write
from nvsf_core.drives.catalogue import home_from_environment
from nvsf_core.errors import DataError
from nvsf_core.recipe.paper import PaperRecipe
from nvsf_core.stages.runner.run import DEFAULT_RECIPE, run_scene

_SEED = 0
"""The only one that curves train of the paper's family."""


def equally_long(curves: Path, recipes: Path, scene: str) -> PaperRecipe:
    """The scene's best size with as many steps as fit into the seconds of `lean`'s trainings.

    Raises:
        DataError: The curve or `lean` was not measured on this scene yet.
        FileNotFoundError: A size was not.
    """
    curve_path = OneRun(scene, FULL, NAME, _SEED).path(curves)
    curve, lean = read_result(curve_path), recipes / f"{DEFAULT_RECIPE}.json"
    seconds = [row["train_seconds"] for row in measured_rows(lean) if row["scene"] == scene]
    if curve is None or not seconds:
        raise DataError(
            f"expected the curve {curve_path} and a run of {scene} in {lean}, found "
            f"{'no' if curve is None else 'the'} curve and {len(seconds)} runs; "
            f"SCENES={scene} make bench measures both"
        )
    seconds_a_step = curve["run"]["training"]["seconds_a_step"]
    return timed(chosen_size(curves, scene, _SEED), seconds_a_step, statistics.fmean(seconds))


def main() -> None:
    """Train, render, score, and write the tables."""
    home = home_from_environment(os.environ)
    for scene in os.environ.get("SCENES", "").split() or [SCENE]:
        run_scene(scene, home, recipe=equally_long(RESULTS, ROOT / RECIPES, scene), seed=_SEED)
    print(write(home, ROOT))


if __name__ == "__main__":
    main()
