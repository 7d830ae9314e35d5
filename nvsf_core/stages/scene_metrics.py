"""Stage `scene_metrics`: metrics of held-out frames, and of views whose truth is known, for all methods."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from nvsf_core._types import Scalar
from nvsf_core.drives.catalogue import ViewEntry
from nvsf_core.kernels.threads import in_parts
from nvsf_core.metrics.lpips import Lpips, load_lpips
from nvsf_core.metrics.table import COLUMNS, HELD_OUT
from nvsf_core.reporting.error_cloud import ERROR_CLOUD_NAME, WRONG_M, error_cloud_png
from nvsf_core.reporting.scene_outputs import METHODS
from nvsf_core.stages.checks.metrics import TABLE_NAME
from nvsf_core.stages.flow import NOVEL_VIEWS
from nvsf_core.stages.runner.host import code_commit, machine
from nvsf_core.stages.runner.stage import StageOutput, Task
from nvsf_core.stages.scoring.camera import measure_camera
from nvsf_core.stages.scoring.demo_images import demo_images
from nvsf_core.stages.scoring.demo_truth import DemoTruth, measure_demo_view, read_demo_truth
from nvsf_core.stages.scoring.lidar import (
    RecordedScans,
    measure_lidar,
    read_recorded_scans,
    recorded_range_errors,
)
from nvsf_core.stages.scoring.moving_boxes import NO_BOXES, read_moving_boxes
from nvsf_core.stages.scoring.recorded_truth import recorded_truth
from nvsf_core.stages.scoring.rows import Ledger, method_columns
from nvsf_core.stages.scoring.trust.view_rows import measure_trust, recorded_sensors, shows
from nvsf_core.stages.scoring.view_images import TrueImages, measure_view_images, write_truth
from nvsf_core.stores.arrays import holds_array, read_arrays, read_attrs
from nvsf_core.stores.tables import write_rows


@dataclass(frozen=True, slots=True)
class _Part:
    """One method and sensor of one view; parts are measured in parallel."""

    name: str
    method: Mapping[str, Any]
    """Columns on the method and its cost."""
    measure: Callable[[Ledger], Iterator[str]]
    """Adds rows to a ledger; yields progress."""


def run(task: Task) -> StageOutput:
    """Measure what was rendered; the stage `scene_metrics`."""
    config = task.config
    views = task.store.require(NOVEL_VIEWS.location(config))
    ledger = Ledger(facts={"scene": task.scene.name, "commit": code_commit()})
    recording = read_recorded_scans(task.store.require("sweeps") / "returns.zarr")
    lpips = load_lpips()
    about = _measure_held_out(task, views / HELD_OUT, recording, ledger, lpips)
    about |= _measure_views(task, views, ledger, lpips)
    _measure_trust(task, views, ledger)
    write_rows(task.folder / TABLE_NAME, ledger.rows, COLUMNS)
    output = ledger.output()
    output.metadata |= about | {"machine": machine()}
    _draw_error_cloud(task, views / HELD_OUT / "model.zarr", recording, output)
    return output


def _measure_held_out(
    task: Task, view: Path, recording: RecordedScans | None, ledger: Ledger, lpips: Lpips | None
) -> dict[str, Scalar]:
    """Add the rows of the held-out frames; returns metadata on moving objects."""
    boxes = read_moving_boxes(task.store)
    images, parts = task.store.path("undistorted") / "images.zarr", list[_Part]()
    for name in METHODS:
        path = view / f"{name}.zarr"
        if not path.is_dir():
            task.progress(f"[{task.scene.name}] scene_metrics: no {path.name} in {view}, not measured")
            continue
        method, attrs = _method(task, path)
        if recording is not None and _holds_sweeps(attrs):
            lidar = partial(measure_lidar, path, recording, boxes, lpips=lpips)
            parts.append(_Part(f"{name}, lidar", method, lidar))
        for camera in attrs.get("cameras", []):
            image = partial(measure_camera, path, images, camera, boxes, recording, lpips=lpips)
            parts.append(_Part(f"{name}, {camera}", method, image))
    _measure(task, parts, ledger)
    return {"foreground": NO_BOXES if boxes is None else f"{boxes.objects} moving objects, by their boxes"}


def _measure_views(task: Task, views: Path, ledger: Ledger, lpips: Lpips | None) -> dict[str, Scalar]:
    """Add the rows of the views whose truth is known, and store it; returns metadata on the demo's truth."""
    asked = [view for view in task.scene.views if (views / view.name).is_dir()]
    demo = read_demo_truth(task) if asked else None
    about: dict[str, Scalar] = {} if demo is None else {"demo_truth_gap_m": demo.gap_m}
    if demo is not None and not demo.is_of_this_drive:
        about["demo_truth"] = "views not measured: the drive is not of the demo writer's street"
        demo = None
    for view in asked:
        path = views / view.name / "model.zarr"
        rendered = [] if demo is None else list(demo_images(task, path, view, demo))
        # What the catalogue names comes before the demo's.
        truths = list({one.camera: one for one in (*rendered, *recorded_truth(task, path, view))}.values())
        if truths:
            write_truth(task.folder / view.name, truths)
        _measure(task, list(_parts_of_view(task, views, view, demo, truths, lpips)), ledger)
    return about


def _parts_of_view(
    task: Task, views: Path, view: ViewEntry, demo: DemoTruth | None, truths: Sequence[TrueImages],
    lpips: Lpips | None,
) -> Iterator[_Part]:  # fmt: skip
    """What can be measured of one view: the demo's sweeps, and images whose truth is known."""
    for name in METHODS:
        path = views / view.name / f"{name}.zarr"
        if not path.is_dir():
            continue
        method, attrs = _method(task, path)
        if demo is not None and holds_array(path, "grid_hit"):
            yield _Part(f"{name}, view {view.name},", method, partial(measure_demo_view, path, view, demo))
        for truth in truths:
            if truth.camera in attrs.get("cameras", []):
                images = partial(measure_view_images, path, view.name, truth, lpips=lpips)
                yield _Part(f"{name}, view {view.name}, {truth.camera},", method, images)


def _measure_trust(task: Task, views: Path, ledger: Ledger) -> None:
    """Add what can be said of the model's views without their truth."""
    paths = sorted(views.glob("*/model.zarr"))
    parts = [
        _Part(
            f"view {path.parent.name}, {sensor.name},",
            _method(task, path)[0],
            partial(measure_trust, path, sensor),
        )
        for sensor in recorded_sensors(task, paths)
        for path in paths
        if shows(path, sensor.name)
    ]
    _measure(task, parts, ledger)


def _measure(task: Task, parts: Sequence[_Part], ledger: Ledger) -> None:
    """Measure parts in parallel; the ledger has their rows in the order of the parts."""

    def run(part: _Part) -> Ledger:
        own = Ledger(facts={**ledger.facts, **part.method})
        for done in part.measure(own):
            task.progress(f"[{task.scene.name}] scene_metrics: {part.name} {done}")
        return own

    for own in in_parts(lambda number: run(parts[number]), len(parts)):
        ledger.take(own)


def _method(task: Task, path: Path) -> tuple[dict[str, Any], Mapping[str, Any]]:
    """Columns on the method and its cost, of a stored prediction, and its attributes."""
    attrs = read_attrs(path)
    measured = read_arrays(path, "train_seconds", "peak_memory_mb")
    costs = attrs | {name: float(value[0]) for name, value in measured.items()}
    return method_columns(path.stem, costs, task.config.recipe.name, task.config.seed), attrs


def _holds_sweeps(attrs: Mapping[str, Any]) -> bool:
    """Whether the view has scans; there are only images if all held-out scans are unusable."""
    return attrs.get("sensor") != ""


def _draw_error_cloud(task: Task, path: Path, recording: RecordedScans | None, output: StageOutput) -> None:
    """Write the error cloud of the middle held-out frame, and add it to the output."""
    if recording is None or not path.is_dir() or not _holds_sweeps(read_attrs(path)):
        return
    found = recorded_range_errors(path, recording)
    if found is None:
        return
    frame, points_m, error_m = found
    (task.folder / ERROR_CLOUD_NAME).write_bytes(error_cloud_png(points_m, error_m))
    output.previews[f"range errors above {WRONG_M:.0f} m in red, frame {frame}"] = ERROR_CLOUD_NAME
    output.metadata["error_cloud_frame"] = frame
    output.metadata["error_cloud_wrong_share"] = float(np.mean(~(error_m <= WRONG_M)))
