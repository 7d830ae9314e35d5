"""Seconds and megabytes of a data set a frame, by format.

``SCENES=demo RECIPE=short VIEW=test python -m benchmarks.data_sets.formats`` writes a rendered view of a
trained scene in each format by itself, and the table into docs/data_sets.md. Rendering is the same for all.
"""

import os
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.common.documents import DOCS, markdown_table, measured_on, write_between
from nvsf_core.drives.catalogue import home_from_environment
from nvsf_core.drives.view_entry import EXPORTS, ViewEntry
from nvsf_core.errors import MissingLibraryError
from nvsf_core.metrics.table import HELD_OUT
from nvsf_core.stages.exports.of_view import RenderedView
from nvsf_core.stages.exports.write import write_data_set
from nvsf_core.stages.runner.run import SceneRun, find_scene, plan_run
from nvsf_core.stages.views.instances import boxes_of
from nvsf_core.stores.arrays import read_arrays, read_attrs

PAGE = DOCS / "data_sets.md"
_WARM_UP = "bin"


def main() -> None:
    """Measure each format on each scene, print the table, and write it into the page."""
    home, recipe = home_from_environment(os.environ), os.environ.get("RECIPE") or None
    view, rows = os.environ.get("VIEW") or HELD_OUT, []
    for name in (os.environ.get("SCENES") or "demo").split():
        run = plan_run(find_scene(name), home, recipe=recipe)
        rows += format_rows(run, view)
    head = ["scene", "view", "frames", "cameras", "format", "seconds a frame", "MB a frame"]
    text = measured_on() + markdown_table(head, rows)
    print(text)
    write_between(PAGE, "formats", text)


def format_rows(run: SceneRun, view: str) -> list[list[str]]:
    """A row a format: seconds and megabytes a frame of a stored view; rendering first."""
    path = run.store.require(f"novel_views/{run.config.recipe.name}/{run.config.seed}") / view / "model.zarr"
    arrays, attrs = read_arrays(path), read_attrs(path)
    frames = len(arrays["time_s"])
    about = [f"`{run.scene.name}`", f"`{view}`", str(frames), str(len(attrs.get("cameras", [])))]
    seconds = [arrays[name] for name in arrays if name.endswith("render_seconds")]
    rendering_s = sum(float(np.sum(one)) for one in seconds) / frames
    rows = [[*about, "(rendering)", f"{rendering_s:.2f}", ""]]
    write_once(run, arrays, attrs, _WARM_UP)
    for kind in EXPORTS:
        try:
            taken_s, size_mb = write_once(run, arrays, attrs, kind)
        except MissingLibraryError as error:
            rows.append([*about, f"`{kind}`", f"not run: {error}", ""])
            continue
        rows.append([*about, f"`{kind}`", f"{taken_s / frames:.2f}", f"{size_mb / frames:.2f}"])
    return rows


def write_once(
    run: SceneRun, arrays: dict[str, np.ndarray], attrs: dict[str, object], kind: str
) -> tuple[float, float]:
    """Seconds and megabytes of a data set in one format, with its images, depth, instances and columns."""
    entry = replace(ViewEntry(name="view"), exports=(kind,))
    rendered = RenderedView(
        scene=run.scene.name, sequence=run.scene.sequence, entry=entry, config=run.config, arrays=arrays,
        attrs=attrs,
    )  # fmt: skip
    boxes = boxes_of(run.store)
    with tempfile.TemporaryDirectory(dir=run.store.home) as folder:
        started = time.perf_counter()
        write_data_set(Path(folder), rendered, boxes)
        taken_s = time.perf_counter() - started
        size_mb = sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file()) / 1e6
    return taken_s, size_mb


if __name__ == "__main__":
    main()
