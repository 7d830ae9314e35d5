"""Writing a rendered view: arrays for the metrics, scan and image files as a driver finds them, a picture."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from nvsf_core.drives.kitti360.writer import write_image, write_scan
from nvsf_core.reporting.previews import image_preview, range_preview
from nvsf_core.stages.field import STAGE as FIELD_STAGE
from nvsf_core.stages.runner.record import read_record
from nvsf_core.stages.runner.stage import Check, StageOutput, Task
from nvsf_core.stores.arrays import write_arrays


def write_method(
    task: Task,
    view: str,
    method: str,
    arrays: dict[str, np.ndarray],
    sensor: str,
    scene_origin_m: np.ndarray,
    *,
    by_images: bool = False,
) -> None:
    """One method's arrays of a view, and what a table wants to know of the method.

    Args:
        task: The stage's own.
        view: Name of the view.
        method: `model` or a baseline.
        arrays: Everything that is published, poses included.
        sensor: Name of the simulated LiDAR; empty where there is none.
        scene_origin_m: (3,) in the world.
        by_images: Whether images answered rays above the recorded lasers.
    """
    folder = task.folder / view
    folder.mkdir(parents=True, exist_ok=True)
    attrs: dict[str, Any] = {
        "split": view,
        "sensor": sensor,
        "method": method,
        "recipe": task.config.recipe.name if method == "model" else method,
        "seed": task.config.seed,
        "cameras": _cameras(arrays),
        "scene_origin_m": scene_origin_m.tolist(),
        "above_lasers_by_images": by_images,
        **_costs(task, method),
    }
    write_arrays(folder / f"{method}.zarr", arrays, attrs)


def _costs(task: Task, method: str) -> dict[str, float]:
    """What making the method cost: seconds, numbers, megabytes."""
    if method == "copy_nearest":
        return {"train_seconds": 0.0, "parameters": 0, "model_mb": 0.0, "peak_memory_mb": 0.0}
    if method == "mesh":
        made = read_record(task.store.require("mesh")) or {"seconds": 0.0, "metadata": {}}
        return {
            "train_seconds": made["seconds"],
            "parameters": 0,
            "model_mb": made["metadata"].get("model_mb", 0.0),
            "peak_memory_mb": 0.0,
        }
    evidence = task.store.require("evidence")
    record = read_record(evidence) or {"seconds": 0.0}
    evidence_mb = sum(p.stat().st_size for p in evidence.rglob("*") if p.is_file()) / 1e6
    if method == "reproject":
        return {
            "train_seconds": record["seconds"],
            "parameters": 0,
            "model_mb": evidence_mb,
            "peak_memory_mb": 0.0,
        }
    field = (read_record(task.store.require(FIELD_STAGE.location(task.config))) or {"metadata": {}})[
        "metadata"
    ]
    return {
        "train_seconds": record["seconds"] + _number(field, "train_seconds"),
        "parameters": _number(field, "parameters"),
        "model_mb": evidence_mb + _number(field, "model_mb"),
        "peak_memory_mb": _number(field, "peak_memory_mb"),
    }


def _number(metadata: dict[str, Any], name: str) -> float:
    """A number that the field's record says; NaN where it says none."""
    value = metadata.get(name)
    return value if isinstance(value, int | float) else math.nan


def export_files(folder: Path, arrays: dict[str, np.ndarray], frame: np.ndarray) -> None:
    """Scans and images as files, as a driver finds them.

    Args:
        folder: Of the view.
        arrays: What was rendered.
        frame: (n,) nearest recorded frame of each scan.
    """
    if "points_m" in arrays:
        for index, number in enumerate(_numbers(frame)):
            part = slice(int(arrays["offsets"][index]), int(arrays["offsets"][index + 1]))
            path = folder / "velodyne_points" / "data" / f"{number:010d}.bin"
            path.parent.mkdir(parents=True, exist_ok=True)
            write_scan(path, arrays["points_m"][part], arrays["intensity"][part])
    for name in _cameras(arrays):
        for number, rgb in zip(_numbers(arrays[f"{name}_frame"]), arrays[f"{name}_rgb"], strict=True):
            target = folder / name / "data_rect" / f"{number:010d}.png"
            target.parent.mkdir(parents=True, exist_ok=True)
            write_image(target, rgb)


def describe_view(output: StageOutput, view: str, folder: Path, arrays: dict[str, np.ndarray]) -> None:
    """Numbers, a picture and a check of one view."""
    if "points_m" in arrays:
        _describe_scans(output, view, folder, arrays)
    for name in _cameras(arrays):
        output.metadata[f"{view}_{name}_images"] = len(arrays[f"{name}_rgb"])
        seconds = float(np.median(arrays[f"{name}_render_seconds"]))
        output.metadata[f"{view}_{name}_seconds_per_image"] = seconds
        (folder / f"{name}.png").write_bytes(image_preview(arrays[f"{name}_rgb"][0]))
        output.previews[f"{view} {name}"] = f"{view}/{name}.png"


def _describe_scans(output: StageOutput, view: str, folder: Path, arrays: dict[str, np.ndarray]) -> None:
    returns = np.diff(arrays["offsets"])
    output.metadata[f"{view}_sweeps"] = len(returns)
    output.metadata[f"{view}_returns_per_sweep"] = float(returns.mean())
    output.metadata[f"{view}_lidar_seconds_per_sweep"] = float(np.median(arrays["lidar_render_seconds"]))
    (folder / "range.png").write_bytes(range_preview(arrays["pano_range_m"][0]))
    output.previews[f"{view} range"] = f"{view}/range.png"
    output.checks.append(
        Check(
            name=f"{view}_scans_are_not_empty",
            passed=bool((returns > 0).all()),
            detail=f"{returns.min():,} to {returns.max():,} returns a sweep",
        )
    )


def _numbers(frame: np.ndarray) -> list[int]:
    """File numbers: the nearest recorded frame's, or counted from 0 where two instants share one."""
    is_unique = len(np.unique(frame)) == len(frame)
    return [int(number) for number in (frame if is_unique else range(len(frame)))]


def _cameras(arrays: dict[str, np.ndarray]) -> list[str]:
    return sorted(name.removesuffix("_rgb") for name in arrays if name.endswith("_rgb"))
