"""Write what the finished runs measured: a JSON a recipe, and from these the README's results table.

Run ``python -m benchmarks.results_table`` after ``make demo`` or ``make train``; ``make bench`` does it too.
It reads every scene's ``scene_metrics`` under NVSF_HOME, so that no number in a table is typed by hand. What
was measured elsewhere or earlier stays, unless the same scene, method and seed were measured again.
"""

import json
import os
import statistics
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from benchmarks.machine import machine
from nvsf_core.kitti360.catalogue import home_from_environment
from nvsf_core.metrics.table import BASELINES, mean_rows
from nvsf_core.stores.tables import read_rows

ROOT = Path(__file__).parents[1]
LIDAR = ("chamfer_m2", "f_score", "range_psnr_db", "hit_accuracy")
BEGIN, END = "<!-- results -->\n", "<!-- end of results -->"

Row = dict[str, Any]


def collect(home: Path) -> dict[str, list[Row]]:
    """Recipe to what its runs measured: one row a scene, method (the recipe or a baseline) and seed."""
    found: dict[str, list[Row]] = {}
    # A killed writer leaves hidden folders behind.
    tables = sorted(home.glob("[!.]*/scene_metrics/[!.]*/[!.]*/metrics.parquet"))
    for path in tables:
        measured = read_rows(path)
        means = [row for row in mean_rows(measured) if (row["split"], row["region"]) == ("test", "all")]
        for scene, method, seed in dict.fromkeys((m["scene"], m["recipe"], m["seed"]) for m in means):
            mine = [m for m in means if m["recipe"] == method]
            scan = {m["metric"]: m for m in mine if m["protocol"] == "lidar4d_scan"}
            images = [m["value"] for m in mine if m["metric"] == "image_psnr_db"]
            found.setdefault(path.parts[-3], []).append(
                {"scene": scene, "method": method, "seed": seed, "commit": measured[0]["commit"]}
                | {name: scan[name]["value"] for name in LIDAR}
                | {
                    "image_psnr_db": sum(images) / len(images) if images else None,
                    "train_seconds": scan["chamfer_m2"]["train_seconds"],
                    "render_seconds": scan["chamfer_m2"]["render_seconds"],
                    "parameters": scan["chamfer_m2"]["parameters"],
                    "machine": machine(),
                }
            )
    return found


def merged(old: Iterable[Row], new: Iterable[Row]) -> list[Row]:
    """Rows of both, sorted; a new row takes the place of the old one of its scene, method and seed."""
    rows = {(row["scene"], row["seed"], row["method"]): row for row in [*old, *new]}
    return [rows[key] for key in sorted(rows, key=lambda key: (*key[:2], *_rank(key[2])))]


def as_markdown(rows: Iterable[Row]) -> str:
    """The README's table: means over seeds, with the standard deviation where there are several."""
    groups: dict[tuple[str, str], dict[int, Row]] = {}
    for row in rows:
        # A baseline has no seed: it was measured beside each and is shown once.
        seed = 0 if row["method"] in BASELINES else row["seed"]
        groups.setdefault((row["scene"], row["method"]), {})[seed] = row
    lines = [
        "| scene | method | seeds | CD m² | F | range PSNR dB | hit acc. | image PSNR | train s | sweep s |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for (scene, method), by_seed in sorted(groups.items(), key=lambda item: (item[0][0], *_rank(item[0][1]))):
        mine = list(by_seed.values())
        cells = [
            _cell([row[key] for row in mine], digits)
            for key, digits in (
                ("chamfer_m2", 3), ("f_score", 3), ("range_psnr_db", 1), ("hit_accuracy", 3),
                ("image_psnr_db", 1), ("train_seconds", 0), ("render_seconds", 2),
            )
        ]  # fmt: skip
        seeds = "" if method in BASELINES else str(len(mine))
        lines.append(f"| `{scene}` | `{method}` | {seeds} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def write(home: Path, root: Path) -> str:
    """Bring `<root>/benchmarks/results/recipes/` and the table between the README's marks up to date.

    Returns:
        The table.
    """
    results = root / "benchmarks" / "results" / "recipes"
    results.mkdir(parents=True, exist_ok=True)
    for recipe, rows in collect(home).items():
        target = results / f"{recipe}.json"
        old = json.loads(target.read_text())["rows"] if target.is_file() else []
        target.write_text(json.dumps({"rows": merged(old, rows)}, indent=1) + "\n")
    files = [json.loads(path.read_text()) for path in sorted(results.glob("*.json"))]
    everything = [row for found in files for row in found["rows"]]
    table = as_markdown(everything)
    readme = root / "README.md"
    head, rest = readme.read_text().split(BEGIN)
    _, tail = rest.split(END)
    machines = "; ".join(sorted({row["machine"] for row in everything}))
    text = f"{machines}; mean of the held-out frames, protocol `lidar4d_scan`.\n\n{table}\n"
    readme.write_text(head + BEGIN + text + END + tail)
    return table


def _rank(method: str) -> tuple[int, str]:
    """Models by name, then the baselines in their own order."""
    return (1 + BASELINES.index(method) if method in BASELINES else 0, method)


def _cell(values: list[float | None], digits: int) -> str:
    known = [value for value in values if value is not None]
    if not known:
        return "-"
    spread = f" ± {statistics.stdev(known):.{digits}f}" if len(known) > 1 else ""
    return f"{statistics.fmean(known):.{digits}f}{spread}"


if __name__ == "__main__":
    print(write(home_from_environment(os.environ), ROOT))
