"""Write what the finished runs measured: a JSON a recipe, README's results table, and docs/results.md.

Run ``python -m benchmarks.tables.results_table`` after ``make demo`` or ``make train``; ``make bench`` does
it too. It reads every scene's ``scene_metrics`` under NVSF_HOME, so that no number in a table is typed by
hand. What was measured elsewhere or earlier stays, unless the same scene, method and seed were measured
again.
"""

import functools
import json
import math
import os
import statistics
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.common.documents import ROOT, Row, markdown_table, write_between, write_json
from benchmarks.tables.measured import Column, by_method, cell, commits_of, rank
from benchmarks.tables.results_document import as_document
from benchmarks.tables.targets import OTHER
from nvsf_core.drives.catalogue import home_from_environment
from nvsf_core.metrics.table import BASELINES, HELD_OUT, mean_rows
from nvsf_core.reporting.measured_against import measured_against
from nvsf_core.reporting.stage_record import StageRecord, record_of
from nvsf_core.stages.runner.host import machine
from nvsf_core.stages.runner.record import made_s
from nvsf_core.stages.scene_records import stage_records
from nvsf_core.stores.tables import read_rows

WALK_RESULTS = Path("benchmarks", "results", "voxel_walk.json")
"""Of `benchmarks.kernels.voxel_walk`, in a checkout."""
RECIPES = Path("benchmarks", "results", "recipes")
"""Where in a checkout the finished runs' results lie, a JSON a recipe."""
_SCAN, _IMAGE = "lidar4d_scan", "image"
_ERRORS = (
    (_SCAN, Column("chamfer_m2", "CD m²", 3)), (_SCAN, Column("f_score", "F", 3)),
    (_SCAN, Column("range_psnr_db", "range PSNR dB", 1)), (_SCAN, Column("hit_accuracy", "hit acc.", 3)),
    (_IMAGE, Column("image_psnr_db", "image PSNR", 1)),
)  # fmt: skip
_SECONDS = {"train_seconds": ("train s", 0), "render_seconds": ("sweep s", 2)}
_PARTIAL = " `*`: over fewer of them, for in the others the method gave nothing to measure."
_BASELINES = "baselines"
"""Name of their file."""


def collect(home: Path) -> dict[str, list[Row]]:
    """Recipe to what its runs measured: one row a scene and seed; the baselines' beside the newest run.

    A row's `errors` hold, by split, protocol, region and sensor with strokes between them, each metric's
    mean over the frames where it is defined, null where it is defined on none; its `undefined` in the same
    way on how many frames a metric is not, where it is not on all; its `views` a digest of each view with
    errors, by which `of_same_views` tells which compare.
    """
    found: dict[str, list[Row]] = {}
    records_of = functools.cache(stage_records)
    # A killed writer leaves hidden folders behind.
    tables = home.glob("[!.]*/scene_metrics/[!.]*/[!.]*/metrics.parquet")
    for path in sorted(tables, key=lambda table: made_s(table.parent)):
        measured = read_rows(path)
        means = mean_rows(measured)
        recipe, of_seed = path.parts[-3:-1]
        records = records_of(path.parents[3])
        shared = {
            "machine": _machine(record_of(records, "scene_metrics", recipe, of_seed)),
            "views": dict(measured_against(records, recipe, of_seed, measured).views),
        }
        for scene, method, seed in dict.fromkeys((m["scene"], m["recipe"], m["seed"]) for m in means):
            mine = [m for m in means if m["recipe"] == method]
            about = {"scene": scene, "method": method, "seed": seed, "commit": measured[0]["commit"]}
            # A baseline has no seed: it was measured beside each.
            file, own = (_BASELINES, {"seed": 0}) if method in BASELINES else (recipe, {})
            found.setdefault(file, []).append(about | own | _costs(mine) | shared | _errors(mine))
    return found


def measured_rows(path: Path) -> list[Row]:
    """The rows of a recipe's file, sorted; none where there is no file."""
    rows: list[Row] = json.loads(path.read_text())["rows"] if path.is_file() else []
    return rows


def merged(old: Iterable[Row], new: Iterable[Row]) -> list[Row]:
    """Rows of both, sorted; a new row takes the place of the old one of its scene, method and seed."""
    rows = {(row["scene"], row["seed"], row["method"]): row for row in [*old, *new]}
    return [rows[key] for key in sorted(rows, key=lambda key: (*key[:2], *rank(key[2])))]


def as_markdown(rows: Iterable[Row]) -> str:
    """The README's table: means over seeds, with the standard deviation where there are several."""
    lines = []
    for (scene, method), mine in by_method(rows).items():
        cells = [mine.cell(protocol, column) for protocol, column in _ERRORS]
        cells += [cell([row[name] for row in mine.rows], digits) for name, (_, digits) in _SECONDS.items()]
        lines.append([f"`{scene}`", f"`{method}`", mine.seeds, *cells, commits_of(mine.rows)])
    titles = [*(column.title for _, column in _ERRORS), *(title for title, _ in _SECONDS.values())]
    return markdown_table(["scene", "method", "seeds", *titles, "commit"], lines)


def of_one_commit(rows: Iterable[Row]) -> list[Row]:
    """The rows of the commit at which most were measured: those of several commits do not compare."""
    found = list(rows)
    commits = Counter(row["commit"] for row in found).most_common(1)
    return [row for row in found if [row["commit"]] == [commit for commit, _ in commits]]


def walk_table(root: Path) -> str:
    """The section of docs/results.md in a checkout; empty where nothing was measured."""
    path = root / WALK_RESULTS
    if not path.is_file():
        return ""
    facts = json.loads(path.read_text())
    about = (
        f"## The walk through the voxels\n\n"
        f"`python -m benchmarks.kernels.voxel_walk`: million rays a second. *build*: all training returns to "
        f"surfels of both kinds, see-throughs counted; *list*: the surfaces a ray may end on; *answer*: the "
        f"range that `reproject` gives; its error is that of the held-out returns. "
        f"Machine: {facts['machine']}. Commit {facts['commit']}. Target: a walk of at least 1.\n\n"
    )
    rates = ("build", "list", "answer")
    rows = [
        [
            f"`{row['scene']}`", row["surfaces"], f"{row['voxel_m']:.2f}", f"{row['voxels']:,}",
            *(f"{row[f'{name}_rays_s'] / 1e6:.2f}" for name in rates), f"{row['median_error_m']:.4f}",
        ]
        for row in facts["rows"]
    ]  # fmt: skip
    head = ["scene", "surfaces", "voxel m", "voxels", *rates, "median error m"]
    return about + markdown_table(head, rows)


def write(home: Path, root: Path) -> str:
    """Bring `<root>/benchmarks/results/recipes/`, README's table and docs/results.md up to date.

    Returns:
        The table.
    """
    results = root / RECIPES
    for recipe, rows in collect(home).items():
        target = results / f"{recipe}.json"
        write_json(target, {"rows": merged(measured_rows(target), rows)})
    everything = [row for path in sorted(results.glob("*.json")) for row in measured_rows(path)]
    sections = [as_document(everything), walk_table(root)]
    (root / "docs" / "results.md").write_text("\n".join(filter(None, sections)))
    shown = of_one_commit(row for row in everything if not row["scene"].startswith(OTHER))
    table = as_markdown(shown)
    machines = "; ".join(sorted({row["machine"] for row in shown}))
    partial = _PARTIAL if "*" in table else ""
    about = f"{machines}; mean of the catalogue's held-out frames, protocol `{_SCAN}`.{partial}\n\n"
    write_between(root / "README.md", "results", about + table)
    return table


def _machine(record: StageRecord | None) -> str:
    """Where a run was measured; records of before say nothing, then it is taken for this machine."""
    measured_on = None if record is None else record.metadata.get("machine")
    return machine() if measured_on is None else str(measured_on)


def _costs(means: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """What a method took, of images the mean over its cameras, and how many frames say so."""
    held_out = [row for row in means if row["split"] == HELD_OUT]
    costs = {name: means[0][name] for name in ("train_seconds", "parameters", "model_mb")}
    return costs | {
        "render_seconds": _seconds(held_out, _SCAN),
        "image_seconds": _seconds(held_out, _IMAGE),
        "frames": max((row["n_frames"] for row in held_out), default=0),
    }


def _seconds(held_out: Iterable[dict[str, Any]], protocol: str) -> float | None:
    """Seconds to render a frame, mean over the sensors of a protocol; None if it has none."""
    of_sensor = {row["sensor"]: row["render_seconds"] for row in held_out if row["protocol"] == protocol}
    return statistics.fmean(of_sensor.values()) if of_sensor else None


def _errors(means: Iterable[dict[str, Any]]) -> dict[str, dict[str, dict[str, Any]]]:
    errors: dict[str, dict[str, float | None]] = {}
    undefined: dict[str, dict[str, int]] = {}
    for row in means:
        # Of regions only the boxes of moving objects have a table.
        if row["region"] != ("foreground" if row["protocol"] == "masked" else "all"):
            continue
        place = "/".join(row[key] for key in ("split", "protocol", "region", "sensor"))
        value = row["value"]
        errors.setdefault(place, {})[row["metric"]] = None if math.isnan(value) else value
        if row["n_defined"] < row["n_frames"]:
            undefined.setdefault(place, {})[row["metric"]] = row["n_frames"] - row["n_defined"]
    return {"errors": errors, "undefined": undefined}


if __name__ == "__main__":
    print(write(home_from_environment(os.environ), ROOT))
