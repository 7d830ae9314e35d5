"""A data set as a drive: written as `kitti360`, ingested, trained and measured again.

``NVSF_SCENES=... SCENES=k360_street RECIPE=quick python -m benchmarks.data_sets.closed_loop`` trains the
scenes where they are not, renders all their frames on the recorded path, trains each data set as the scene
`<scene>_again`, and writes the errors of both generations beside each other into docs/data_sets.md.
"""

import math
import os
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from benchmarks.common.documents import DOCS, commit, markdown_table, write_between
from nvsf_core.drives.catalogue import SceneEntry, home_from_environment
from nvsf_core.metrics.table import HELD_OUT, Row, mean_rows
from nvsf_core.stages import run_scene
from nvsf_core.stages.render_view import render_view
from nvsf_core.stages.runner.host import machine
from nvsf_core.stages.runner.run import find_scene
from nvsf_core.stores.tables import read_rows

PAGE = DOCS / "data_sets.md"
_SHOWN = (
    ("lidar4d_scan", "chamfer_m2", "CD m²", 3), ("lidar4d_scan", "f_score", "F", 3),
    ("lidar4d_scan", "range_psnr_db", "range PSNR dB", 1), ("lidar4d_scan", "hit_accuracy", "hit acc.", 3),
    ("raw", "range_abs_error_median_m", "median range error m", 3),
    ("image", "image_psnr_db", "image PSNR dB", 1),
)  # fmt: skip
"""Protocol, metric, head of the column and digits."""


def main() -> None:
    """Train both generations of every scene, print their errors, and write them into the page."""
    home, recipe = home_from_environment(os.environ), os.environ.get("RECIPE") or "quick"
    rows = []
    for name in (os.environ.get("SCENES") or "k360_street").split():
        scene = find_scene(name)
        run_scene(scene, home, recipe=recipe)
        again = second_generation(scene, home, recipe)
        run_scene(again, home, recipe=recipe)
        for generation, entry in (("recorded", scene), ("synthetic", again)):
            table = home / entry.name / "scene_metrics" / recipe / "0" / "metrics.parquet"
            rows.append([f"`{name}`", generation, *cells(read_rows(table), recipe)])
    text = f"{machine()}; recipe `{recipe}`, seed 0, commit {commit()}.\n\n" + loop_table(rows)
    print(text)
    write_between(PAGE, "loop", text)


def second_generation(scene: SceneEntry, home: Path, recipe: str) -> SceneEntry:
    """Write all frames of a trained scene as a drive; returns its entry, with the same held-out frames."""
    folder = home / "drives" / f"{scene.name}_again"
    # Written anew: the model may be another one.
    shutil.rmtree(folder, ignore_errors=True)
    render_view(
        replace(scene, views=()), {"name": "again", "exports": ["kitti360"]}, home, out=folder, recipe=recipe
    )
    name = f"{scene.name}_again"
    return replace(scene, name=name, root=folder / "kitti360", views=(), recipe=recipe, sweep_period_s=None)


def cells(rows: Sequence[Row], recipe: str) -> Iterator[str]:
    """Mean errors of the held-out frames as they are shown; of images over the cameras."""
    means = [
        row for row in mean_rows(rows)
        if (row["recipe"], row["split"], row["region"]) == (recipe, HELD_OUT, "all") and row["n_defined"]
    ]  # fmt: skip
    for protocol, metric, _, digits in _SHOWN:
        found = [row["value"] for row in means if (row["protocol"], row["metric"]) == (protocol, metric)]
        value = sum(found) / len(found) if found else math.nan
        yield "–" if math.isnan(value) else f"{value:.{digits}f}"


def loop_table(rows: Sequence[Sequence[str]]) -> str:
    """The table of both generations; each is measured on what it was trained from."""
    return markdown_table(["scene", "trained from", *(head for _, _, head, _ in _SHOWN)], rows)


if __name__ == "__main__":
    main()
