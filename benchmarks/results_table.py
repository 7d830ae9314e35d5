"""Write what the finished runs measured: the README's results table and a JSON beside it.

Run ``python -m benchmarks.results_table`` after ``make demo`` or ``make train``. It reads every scene's
``scene_metrics`` under NVSF_HOME, so that no number in a table is typed by hand.
"""

import json
import os
import platform
from pathlib import Path
from typing import Any

from nvsf_core.kitti360.catalogue import home_from_environment
from nvsf_core.metrics.table import mean_rows
from nvsf_core.stores.tables import read_rows

ROOT = Path(__file__).parents[1]
LIDAR = ("chamfer_m2", "f_score", "range_psnr_db", "hit_accuracy")
BEGIN, END = "<!-- results -->\n", "<!-- end of results -->"


def machine() -> str:
    """Processor family and cores."""
    python = platform.python_version()
    return f"{platform.machine()}, {os.cpu_count()} CPU cores, Python {python}, not run on a GPU"


def collect(home: Path) -> list[dict[str, Any]]:
    """One row a scene, method and seed."""
    rows: list[dict[str, Any]] = []
    for path in sorted(home.glob("*/scene_metrics/*/*/metrics.parquet")):
        measured = read_rows(path)
        means = mean_rows(measured)
        for scene, recipe, seed in dict.fromkeys((m["scene"], m["recipe"], m["seed"]) for m in means):
            mine = [m for m in means if m["recipe"] == recipe and m["split"] == "test"]
            scan = {m["metric"]: m for m in mine if m["protocol"] == "lidar4d_scan"}
            images = [m["value"] for m in mine if m["metric"] == "image_psnr_db"]
            rows.append(
                {"scene": scene, "method": recipe, "seed": seed, "commit": measured[0]["commit"]}
                | {name: scan[name]["value"] for name in LIDAR}
                | {
                    "image_psnr_db": sum(images) / len(images) if images else None,
                    "train_seconds": scan["chamfer_m2"]["train_seconds"],
                    "render_seconds": scan["chamfer_m2"]["render_seconds"],
                    "parameters": scan["chamfer_m2"]["parameters"],
                }
            )
    return rows


def as_markdown(rows: list[dict[str, Any]]) -> str:
    """The README's table."""
    lines = [
        "| scene | method | CD m² | F | range PSNR dB | hit acc. | image PSNR dB | training s | sweep s |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for row in rows:
        image = "-" if row["image_psnr_db"] is None else f"{row['image_psnr_db']:.1f}"
        seconds = f"{row['train_seconds']:.0f} | {row['render_seconds']:.2f}"
        lines.append(
            f"| `{row['scene']}` | `{row['method']}` | {row['chamfer_m2']:.3f} | {row['f_score']:.3f} | "
            f"{row['range_psnr_db']:.1f} | {row['hit_accuracy']:.3f} | {image} | {seconds} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Replace the table between the README's two marks, and write the JSON."""
    rows = collect(home_from_environment(os.environ))
    readme = ROOT / "README.md"
    head, rest = readme.read_text().split(BEGIN)
    _, tail = rest.split(END)
    text = f"{machine()}; mean of the held-out frames, protocol `lidar4d_scan`.\n\n{as_markdown(rows)}\n"
    readme.write_text(head + BEGIN + text + END + tail)
    target = ROOT / "benchmarks" / "results" / "quick.json"
    target.write_text(json.dumps({"machine": machine(), "rows": rows}, indent=1) + "\n")
    print(as_markdown(rows))


if __name__ == "__main__":
    main()
