"""Trust scores of the baselines' views beside their true errors; the score was not tuned on these views.

``SCENES=street python -m benchmarks.views.trust_of_baselines`` compares what a run of RECIPE (default: quick)
rendered by the baselines with the recording, as `scene_metrics` does for the model, prints rank correlations,
and writes them into docs/trust.md.
"""

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.common.documents import markdown_table, write_between
from benchmarks.views.trust import ERRORS, HEADS, PAGE, ScoredView, rank_correlation
from nvsf_core.drives.catalogue import home_from_environment
from nvsf_core.metrics.table import HELD_OUT, mean_rows
from nvsf_core.metrics.trust.verdict import LIDAR, score_of
from nvsf_core.stages.runner.run import find_scene, plan_run, say_on_stderr
from nvsf_core.stages.runner.stage import Task
from nvsf_core.stages.scoring.trust.view_rows import recorded_sensors, shows
from nvsf_core.stores.tables import read_rows

_BASELINES = ("reproject", "mesh")
"""Those that render; a copied scan or image has no depth of its own place."""


def main() -> None:
    """Print the table, and write it into the page."""
    home, recipe = home_from_environment(os.environ), os.environ.get("RECIPE") or "quick"
    run = plan_run(find_scene(os.environ.get("SCENES") or "street"), home, recipe=recipe)
    views = list(_scored(run.task(home, say_on_stderr), recipe))
    rows = []
    for kind, metrics in ERRORS.items():
        mine = [one for one in views if (one.sensor == LIDAR) == (kind == "scans")]
        for words, some in (*((name, [v for v in mine if v.words == name]) for name in _BASELINES),
                            ("both", mine)):  # fmt: skip
            for _, metric in metrics:
                count, rho = rank_correlation(some, metric)
                rows.append((kind, words, count, HEADS[metric], f"{rho:.2f}"))
    text = markdown_table(("of", "rendered by", "number", "true error", "rank correlation"), rows)
    print(text)
    write_between(PAGE, "baselines", text)


def _scored(task: Task, recipe: str) -> Iterator[ScoredView]:
    """The baselines' scans and images, one of each view, sensor and baseline; held-out frames left out."""
    views = task.store.require(f"novel_views/{recipe}/0")
    means = mean_rows(read_rows(task.store.require(f"scene_metrics/{recipe}/0") / "metrics.parquet"))
    for sensor in recorded_sensors(task, sorted(views.glob("*/model.zarr"))):
        for path in sorted(path for name in _BASELINES for path in views.glob(f"*/{name}.zarr")):
            if path.parent.name == HELD_OUT or not shows(path, sensor.name):
                continue
            score = np.mean([score_of(cues, sensor.name) for _, cues in sensor.cues_of(path)])
            yield ScoredView(
                task.scene.name, path.parent.name, sensor.name, path.stem, float(score),
                _errors(means, path, sensor.name),
            )  # fmt: skip


def _errors(means: list[dict], path: Path, sensor: str) -> dict[str, float]:
    """Metric to its true value of a baseline's view by one sensor."""
    return {
        row["metric"]: float(row["value"]) for row in means
        if (row["recipe"], row["split"], row["sensor"]) == (path.stem, path.parent.name, sensor)
        and row["region"] == "all" and row["protocol"] in ("raw", "image")
    }  # fmt: skip


if __name__ == "__main__":
    main()
