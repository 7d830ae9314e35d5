"""Writing a rendered view: arrays for the metrics, scan and image files as a driver finds them, a picture."""

from pathlib import Path
from typing import Any

import numpy as np

from nvsf_core.cameras.images import write_image
from nvsf_core.kitti360.writer import write_scan
from nvsf_core.reporting.previews import image_preview, range_preview
from nvsf_core.simulation.view_plan import ViewPlan
from nvsf_core.stages.field import STAGE as FIELD_STAGE
from nvsf_core.stages.stage import Check, StageOutput, Task, read_record
from nvsf_core.stores.arrays import write_arrays


def write_method(
    folder: Path,
    method: str,
    task: Task,
    plan: ViewPlan,
    lidar_to_world: np.ndarray,
    scene_origin_m: np.ndarray,
    arrays: dict[str, np.ndarray],
) -> None:
    """One method's arrays of a view, its poses (n, 4, 4), and what a table wants to know of the method."""
    folder.mkdir(parents=True, exist_ok=True)
    attrs: dict[str, Any] = {
        "split": plan.name,
        "sensor": plan.table.name,
        "method": method,
        "recipe": task.config.recipe.name if method == "model" else method,
        "seed": task.config.seed,
        "cameras": sorted(name[:-4] for name in arrays if name.endswith("_rgb")),
        "scene_origin_m": scene_origin_m.tolist(),
        **_costs(task, method),
    }
    known = {"frame": plan.frame, "time_s": plan.time_s, "lidar_to_world": lidar_to_world}
    write_arrays(folder / f"{method}.zarr", arrays | known, attrs)


def _costs(task: Task, method: str) -> dict[str, float]:
    """What making the method cost: seconds, numbers, megabytes."""
    if method == "copy_nearest":
        return {"train_seconds": 0.0, "parameters": 0, "model_mb": 0.0, "peak_memory_mb": 0.0}
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
    field = (read_record(task.store.require(FIELD_STAGE.location(task.config))) or {})["metadata"]
    return {
        "train_seconds": record["seconds"] + field["train_seconds"],
        "parameters": field["parameters"],
        "model_mb": evidence_mb + field["model_mb"],
        "peak_memory_mb": field["peak_memory_mb"],
    }


def export_files(
    folder: Path, lidar: dict[str, np.ndarray], cameras: dict[str, np.ndarray], plan: ViewPlan
) -> None:
    """Scans and images as files, as a driver finds them; several instants of one frame are numbered on."""
    numbers = plan.frame if len(set(plan.frame.tolist())) == len(plan.frame) else np.arange(len(plan.frame))
    for index, number in enumerate(numbers):
        part = slice(int(lidar["offsets"][index]), int(lidar["offsets"][index + 1]))
        path = folder / "velodyne_points" / "data" / f"{number:010d}.bin"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_scan(path, lidar["points_m"][part], lidar["intensity"][part])
        for name in (key[:-4] for key in cameras if key.endswith("_rgb")):
            target = folder / name / "data_rect" / f"{number:010d}.png"
            target.parent.mkdir(parents=True, exist_ok=True)
            write_image(target, cameras[f"{name}_rgb"][index])


def describe_view(
    output: StageOutput, view: str, folder: Path, lidar: dict[str, np.ndarray], cameras: dict[str, np.ndarray]
) -> None:
    """Numbers, a picture and a check of one view."""
    returns = np.diff(lidar["offsets"])
    output.metadata[f"{view}_sweeps"] = len(returns)
    output.metadata[f"{view}_returns_per_sweep"] = float(returns.mean())
    output.metadata[f"{view}_lidar_seconds_per_sweep"] = float(np.median(lidar["lidar_render_seconds"]))
    (folder / "range.png").write_bytes(range_preview(lidar["pano_range_m"][0]))
    output.previews[f"{view} range"] = f"{view}/range.png"
    for name in (key for key in cameras if key.endswith("_rgb")):
        (folder / f"{name[:-4]}.png").write_bytes(image_preview(cameras[name][0]))
        output.previews[f"{view} {name[:-4]}"] = f"{view}/{name[:-4]}.png"
    output.checks.append(
        Check(
            name=f"{view}_scans_are_not_empty",
            passed=bool((returns > 0).all()),
            detail=f"{returns.min():,} to {returns.max():,} returns a sweep",
        )
    )
