"""`scene_metrics`: the held-out frames, measured for the model and the baselines."""

import math
import subprocess
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from nvsf_core.errors import StoreError
from nvsf_core.metrics.image import image_metrics
from nvsf_core.metrics.lpips import Lpips, load_lpips
from nvsf_core.metrics.measure import Measure
from nvsf_core.metrics.protocols import PanoImage, RayAnswers, Scan, lidar4d, project_scan, raw
from nvsf_core.metrics.table import COLUMNS, UNITS, mean_rows, summary_table
from nvsf_core.sensors.linear_pano import LinearPano
from nvsf_core.stages.stage import Check, Scalar, Stage, StageOutput, Task
from nvsf_core.stores.arrays import read_arrays, read_attrs
from nvsf_core.stores.tables import write_rows

METHODS = ("model", "reproject", "copy_nearest")
"""Stored predictions of the view `test`, in the order in which they are measured."""
SPLIT = "test"
TABLE_NAME = "metrics.parquet"

_HEADLINES = (
    ("lidar4d_scan", "chamfer_m2"), ("lidar4d_scan", "f_score"), ("lidar4d_scan", "range_psnr_db"),
    ("raw", "range_abs_error_median_m"), ("raw", "hit_accuracy"), ("image", "image_psnr_db"),
)  # fmt: skip


@dataclass(slots=True)
class _Ledger:
    """Rows of the table, and why values in it are undefined."""

    facts: dict[str, Any]
    """Columns that are the same for all rows."""
    rows: list[dict[str, Any]] = field(default_factory=list)
    reasons: Counter[str] = field(default_factory=Counter)

    def add(
        self,
        measures: Mapping[str, Measure],
        method: Mapping[str, Any],
        *,
        protocol: str,
        sensor: str,
        frame: int,
        render_seconds: float,
    ) -> None:
        for metric, measure in measures.items():
            if measure.reason:
                self.reasons[f"{protocol} {metric}: {measure.reason}"] += 1
            self.rows.append(
                {
                    **self.facts, **method, "protocol": protocol, "sensor": sensor, "frame": frame,
                    "metric": metric, "value": measure.value, "unit": UNITS[metric],
                    "n_valid": measure.n_valid, "render_seconds": render_seconds,
                }
            )  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Recording:
    """The recorded scans, by frame."""

    arrays: dict[str, np.ndarray]
    n_lasers: int

    def scan(self, frame: int) -> tuple[Scan, RayAnswers]:
        """The recorded scan of a frame, and range and intensity along its rays.

        Raises:
            StoreError: The frame has no valid recorded scan.
        """
        a = self.arrays
        found = np.flatnonzero(a["frame"] == frame)
        if found.size != 1:
            raise StoreError(
                f"frame {frame} is rendered in the view {SPLIT!r}, but sweeps/returns.zarr holds it "
                f"{found.size} times; run novel_views again"
            )
        cut = _part(a["offsets"], int(found[0]))
        scan = Scan(points_m=a["points_m"][cut], intensity=a["intensity"][cut], laser=a["laser"][cut])
        return scan, RayAnswers(range_m=a["range_m"][cut], intensity=a["intensity"][cut])


def _run(task: Task) -> StageOutput:
    store, config = task.store, task.config
    view = store.require(f"novel_views/{config.recipe.name}/{config.seed}") / SPLIT
    lpips = load_lpips()
    ledger = _Ledger(facts={"scene": task.scene.name, "split": SPLIT, "region": "all", "commit": _commit()})
    recording = _read_recording(store.require("sweeps") / "returns.zarr")
    for name in METHODS:
        path = view / f"{name}.zarr"
        if not path.is_dir():
            task.progress(f"[{task.scene.name}] scene_metrics: no {path.name} in {view}, not measured")
            continue
        attrs = read_attrs(path)
        method = _method_columns(name, attrs, config.recipe.name, config.seed)
        for done in _measure_lidar(path, recording, method, ledger, lpips):
            task.progress(f"[{task.scene.name}] scene_metrics: {name}, lidar {done}")
        images = store.path("undistorted") / "images.zarr"
        for camera in attrs.get("cameras", []):
            for done in _measure_camera(path, images, camera, method, ledger, lpips):
                task.progress(f"[{task.scene.name}] scene_metrics: {name}, {camera} {done}")
    write_rows(task.folder / TABLE_NAME, ledger.rows, COLUMNS)
    return _output(ledger)


def _measure_lidar(
    path: Path, recording: _Recording | None, method: Mapping[str, Any], ledger: _Ledger, lpips: Lpips | None
) -> Iterator[str]:
    """Add the rows of the LiDAR protocols, yielding after each frame."""
    frames = read_arrays(path, "frame")["frame"]
    if recording is None or frames.size == 0:
        return
    names = ("offsets", "points_m", "intensity", "laser", "pano_range_m", "pano_intensity", "pano_hit")
    a = read_arrays(path, *names, "ray_offsets", "ray_range_m", "ray_intensity", "lidar_render_seconds")
    pano = LinearPano(quirks=True)
    for i, frame in enumerate(frames.tolist()):
        truth, truth_rays = recording.scan(frame)
        own, rays = _part(a["offsets"], i), _part(a["ray_offsets"], i)
        predicted = Scan(points_m=a["points_m"][own], intensity=a["intensity"][own], laser=a["laser"][own])
        answers = RayAnswers(range_m=a["ray_range_m"][rays], intensity=a["ray_intensity"][rays])
        image = PanoImage(
            range_m=a["pano_range_m"][i], intensity=a["pano_intensity"][i], hit=a["pano_hit"][i]
        )
        true_image = project_scan(pano, truth)
        by_protocol = {
            "lidar4d": lidar4d(image, true_image, pano, lpips),
            "lidar4d_scan": lidar4d(project_scan(pano, predicted), true_image, pano, lpips),
            "raw": raw(predicted, answers, truth, truth_rays, recording.n_lasers),
        }
        seconds = float(a["lidar_render_seconds"][i])
        for protocol, measures in by_protocol.items():
            ledger.add(
                measures, method, protocol=protocol, sensor="lidar", frame=frame, render_seconds=seconds
            )
        yield f"frame {frame} ({i + 1} of {frames.size})"


def _measure_camera(
    path: Path, images: Path, camera: str, method: Mapping[str, Any], ledger: _Ledger, lpips: Lpips | None
) -> Iterator[str]:
    """Add the rows of one camera, yielding after each frame."""
    a = read_arrays(path, f"{camera}_rgb", f"{camera}_frame", f"{camera}_render_seconds")
    true = read_arrays(images, f"{camera}_rgb", f"{camera}_valid", f"{camera}_frame")
    index = {frame: row for row, frame in enumerate(true[f"{camera}_frame"].tolist())}
    frames = a[f"{camera}_frame"].tolist()
    for i, frame in enumerate(frames):
        if frame not in index:
            raise StoreError(
                f"{path}: {camera} of frame {frame} is rendered, but {images} lacks it; run novel_views again"
            )
        truth = true[f"{camera}_rgb"][index[frame]]
        measures = image_metrics(a[f"{camera}_rgb"][i], truth, true[f"{camera}_valid"], lpips)
        seconds = float(a[f"{camera}_render_seconds"][i])
        ledger.add(measures, method, protocol="image", sensor=camera, frame=frame, render_seconds=seconds)
        yield f"frame {frame} ({i + 1} of {len(frames)})"


def _read_recording(path: Path) -> _Recording | None:
    """The recorded scans; None for a drive without a LiDAR."""
    names = ("frame", "offsets", "points_m", "intensity", "laser", "range_m")
    if not path.is_dir() or read_arrays(path, "frame")["frame"].size == 0:
        return None
    arrays = read_arrays(path, *names)
    n_lasers = int(arrays["laser"].max()) + 1 if arrays["laser"].size else 0
    return _Recording(arrays=arrays, n_lasers=n_lasers)


def _method_columns(name: str, attrs: Mapping[str, Any], recipe: str, seed: int) -> dict[str, Any]:
    """Columns that say who made the prediction and at what cost; a cost not stated is NaN."""
    costs = ("train_seconds", "parameters", "model_mb", "peak_memory_mb")
    found = {cost: math.nan if attrs.get(cost) is None else float(attrs[cost]) for cost in costs}
    return {"recipe": recipe if name == "model" else name, "seed": seed, **found}


def _part(offsets: np.ndarray, i: int) -> slice:
    """The i-th part of a flat array that is cut by `offsets`."""
    return slice(int(offsets[i]), int(offsets[i + 1]))


def _output(ledger: _Ledger) -> StageOutput:
    values = np.array([row["value"] for row in ledger.rows], dtype=np.float64)
    n_undefined, n_infinite = int(np.isnan(values).sum()), int(np.isinf(values).sum())
    detail = f"{values.size} values, {n_undefined} undefined, {n_infinite} infinite"
    reasons = "; ".join(f"{reason} ({n} times)" for reason, n in ledger.reasons.most_common())
    metadata: dict[str, Scalar] = {
        "rows": len(ledger.rows), "undefined": n_undefined, "infinite": n_infinite,
        "undefined_reasons": reasons or "none", "table": summary_table(ledger.rows),
    }  # fmt: skip
    for row in mean_rows(ledger.rows):
        if (row["protocol"], row["metric"]) in _HEADLINES and not math.isnan(row["value"]):
            key = f"{row['recipe']}/{row['protocol']}/{row['sensor']}/{row['metric']}"
            metadata[key] = float(row["value"])
    checks = [
        Check(name="some_frame_was_measured", passed=bool(ledger.rows), detail=detail),
        Check(
            name="all_metrics_are_finite",
            passed=n_undefined + n_infinite == 0,
            detail=f"{detail}; {reasons}" if reasons else detail,
        ),
    ]
    return StageOutput(metadata=metadata, checks=checks)


def _commit() -> str:
    """Commit of the checkout that this code lies in; `unknown` outside one."""
    folder = Path(__file__).resolve().parent
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), "rev-parse", "HEAD"], capture_output=True, text=True, check=False
        )
    except OSError:
        return "unknown"
    return done.stdout.strip() if done.returncode == 0 else "unknown"


STAGE = Stage(
    name="scene_metrics",
    group="report",
    inputs=("frames", "sweeps", "undistorted", "novel_views"),
    description=(
        "Errors and times of the held-out frames under each protocol, for the trained field "
        "and for the baselines that learn nothing."
    ),
    version="1",
    run=_run,
    per_recipe=True,
)
