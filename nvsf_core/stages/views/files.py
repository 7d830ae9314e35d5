"""Write a rendered view: arrays for the metrics, scan and image files in KITTI-360's layout, previews."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nvsf_core.clouds.ply import write_pcd, write_ply
from nvsf_core.drives.kitti360.scans import write_scan
from nvsf_core.drives.kitti360.writer import write_grey, write_image
from nvsf_core.errors import DataError
from nvsf_core.rendering.rendered import Support
from nvsf_core.reporting.previews import image_preview, range_preview, support_preview
from nvsf_core.simulation.raydrop import rays_return
from nvsf_core.stages.flow import FIELD
from nvsf_core.stages.runner.record import RECORD_NAME, read_record
from nvsf_core.stages.runner.stage import Check, StageOutput, Task
from nvsf_core.stores.arrays import write_arrays

_WRITERS = {"bin": write_scan, "ply": write_ply, "pcd": write_pcd}


def write_method(
    task: Task,
    view: str,
    method: str,
    arrays: dict[str, np.ndarray],
    about: Mapping[str, Any],
    scene_to_world: np.ndarray,
) -> None:
    """Write one method's arrays of a view, with attributes on the method and its cost.

    Args:
        task: Task of the stage.
        view: Name of the view.
        method: `model` or a baseline.
        arrays: All arrays to publish, poses included.
        about: Attributes of the view: its plan's, `sensor` (empty without a LiDAR), and whether images
            supplied the rays above the recorded lasers.
        scene_to_world: (4, 4) pose of the scene's frame in the world, metres.
    """
    folder = task.folder / view
    folder.mkdir(parents=True, exist_ok=True)
    costs = _costs(task, method)
    # Arrays, for the attributes are content, and what a training took differs each time (`content_of`).
    measured = {name: np.array([costs.pop(name)]) for name in ("train_seconds", "peak_memory_mb")}
    attrs: dict[str, Any] = {
        "split": view,
        **about,
        "method": method,
        "recipe": task.config.recipe.name if method == "model" else method,
        "seed": task.config.seed,
        "cameras": cameras_of(arrays),
        "scene_to_world": scene_to_world.reshape(-1).tolist(),
        **costs,
    }
    write_arrays(folder / f"{method}.zarr", arrays | measured, attrs)


def _costs(task: Task, method: str) -> dict[str, float]:
    """Cost of the method: seconds of preparation and training, parameters, megabytes."""
    nothing = {"train_seconds": 0.0, "parameters": 0, "model_mb": 0.0, "peak_memory_mb": 0.0}
    if method == "copy_nearest":
        return nothing
    if method == "mesh":
        made = read_record(task.store.require("mesh")) or {"seconds": 0.0, "metadata": {}}
        model_mb = made["metadata"].get("model_mb", 0.0)
        return nothing | {"train_seconds": made["seconds"], "model_mb": model_mb}
    evidence = task.store.require("evidence")
    record = read_record(evidence) or {"seconds": 0.0}
    # Without its record: that has seconds, whose digits are no two times as many.
    files = [path for path in evidence.rglob("*") if path.is_file() and path.name != RECORD_NAME]
    evidence_mb = sum(path.stat().st_size for path in files) / 1e6
    if method == "reproject":
        return nothing | {"train_seconds": record["seconds"], "model_mb": evidence_mb}
    made = read_record(task.store.require(FIELD.location(task.config))) or {"metadata": {}}
    field = made["metadata"]
    return {
        "train_seconds": record["seconds"] + _number(field, "train_seconds"),
        "parameters": _number(field, "parameters"),
        "model_mb": evidence_mb + _number(field, "model_mb"),
        "peak_memory_mb": _number(field, "peak_memory_mb"),
    }


def _number(metadata: dict[str, Any], name: str) -> float:
    """A number of the field's metadata; NaN if absent."""
    value = metadata.get(name)
    return value if isinstance(value, int | float) else math.nan


def write_scans(
    folder: Path, numbers: Sequence[int], scans: Sequence[np.ndarray], kinds: Sequence[str] = ("bin",)
) -> list[dict[str, str]]:
    """Write the scans of a view or of a data set as files in KITTI-360's layout.

    Args:
        folder: Folder of the view.
        numbers: File number of each scan.
        scans: Each (N, 4) float32: x, y, z in metres in the sensor's frame, intensity 0..1.
        kinds: `bin`, `ply`, `pcd`.

    Returns:
        For each scan its files by kind, relative to the folder.

    Raises:
        DataError: A value is not finite.
    """
    found = []
    for number, scan in zip(numbers, scans, strict=True):
        if not np.isfinite(scan).all():
            raise DataError(f"{folder}, scan {number}: expected finite returns, found others; render it anew")
        files = {}
        for kind in kinds:
            files[kind] = f"velodyne_points/{'data' if kind == 'bin' else kind}/{number:010d}.{kind}"
            (folder / files[kind]).parent.mkdir(parents=True, exist_ok=True)
            _WRITERS[kind](folder / files[kind], scan[:, :3], scan[:, 3])
        found.append(files)
    return found


def write_images(folder: Path, arrays: Mapping[str, np.ndarray]) -> list[tuple[str, int, int, str]]:
    """Write a view's rendered images as PNG; where their support is known, it as grey values beside them.

    Returns:
        Camera, index among the camera's images, file number, and file relative to the folder.
    """
    found = []
    for name in cameras_of(arrays):
        numbered = zip(file_numbers(arrays, name), arrays[f"{name}_rgb"], strict=True)
        for index, (number, rgb) in enumerate(numbered):
            file = f"{name}/data_rect/{number:010d}.png"
            write_image(folder / file, rgb)
            if f"{name}_support" in arrays:
                classes = arrays[f"{name}_support"][index]
                write_grey(folder / f"{name}/support/{number:010d}.png", classes, np.uint8)
            found.append((name, index, number, file))
    return found


def scans_of(arrays: Mapping[str, np.ndarray]) -> list[np.ndarray]:
    """The rendered scans of a view, each (N, 4) float32 as for `write_scans`; none without a LiDAR."""
    if "points_m" not in arrays:
        return []
    rows = np.concatenate([arrays["points_m"], arrays["intensity"][:, None]], axis=1).astype(np.float32)
    return np.split(rows, arrays["offsets"][1:-1])


def describe_view(output: StageOutput, view: str, folder: Path, arrays: dict[str, np.ndarray]) -> None:
    """Add metadata, previews and a check of one view to the output."""
    if "points_m" in arrays:
        _describe_scans(output, view, folder, arrays)
    for name in cameras_of(arrays):
        output.metadata[f"{view}_{name}_images"] = len(arrays[f"{name}_rgb"])
        seconds = float(np.median(arrays[f"{name}_render_seconds"]))
        output.metadata[f"{view}_{name}_seconds_per_image"] = seconds
        if f"{name}_support" in arrays:
            for support in Support:
                share = float(np.mean(arrays[f"{name}_support"] == support))
                output.metadata[f"{view}_{name}_{support.region}_share"] = share
            classes = arrays[f"{name}_support"][0]
            picture = support_preview(classes, np.ones(classes.shape, np.bool_), row_repeat=1)
            (folder / f"{name}_support.png").write_bytes(picture)
            output.previews[f"{view} {name} support"] = f"{view}/{name}_support.png"
        (folder / f"{name}.png").write_bytes(image_preview(arrays[f"{name}_rgb"][0]))
        output.previews[f"{view} {name}"] = f"{view}/{name}.png"


def _describe_scans(output: StageOutput, view: str, folder: Path, arrays: dict[str, np.ndarray]) -> None:
    returns = np.diff(arrays["offsets"])
    output.metadata[f"{view}_sweeps"] = len(returns)
    output.metadata[f"{view}_returns_per_sweep"] = float(returns.mean())
    output.metadata[f"{view}_lidar_seconds_per_sweep"] = float(np.median(arrays["lidar_render_seconds"]))
    for support in Support if "support" in arrays else ():
        share = float(np.mean(arrays["support"] == support))
        output.metadata[f"{view}_{support.region}_share"] = share
    if "grid_support" in arrays:
        rays = slice(None), slice(int(arrays["grid_firings"][0]))
        picture = support_preview(arrays["grid_support"][0][rays], rays_return(arrays["grid_hit"][0][rays]))
        (folder / "support.png").write_bytes(picture)
        output.previews[f"{view} support"] = f"{view}/support.png"
    (folder / "range.png").write_bytes(range_preview(arrays["pano_range_m"][0]))
    output.previews[f"{view} range"] = f"{view}/range.png"
    output.checks.append(
        Check(
            name=f"{view}_scans_are_not_empty",
            passed=bool((returns > 0).all()),
            detail=f"{returns.min():,} to {returns.max():,} returns a sweep",
        )
    )


def file_numbers(arrays: Mapping[str, np.ndarray], camera: str = "") -> list[int]:
    """File numbers of a view's scans, or of the images of a camera where one is named.

    They are those of the frames; or counted from 0, between frames or where two instants share one.
    """
    frame = arrays[f"{camera}_frame" if camera else "frame"]
    # A held-out frame may lack an image, or its scan: then the camera's own frames are the numbers.
    if "number" in arrays and np.array_equal(frame, arrays["frame"]):
        return [int(number) for number in arrays["number"]]
    is_unique = len(np.unique(frame)) == len(frame)
    return [int(number) for number in (frame if is_unique else range(len(frame)))]


def cameras_of(arrays: Mapping[str, np.ndarray]) -> list[str]:
    """Sorted names of the cameras whose images are in a view's arrays."""
    return sorted(name.removesuffix("_rgb") for name in arrays if name.endswith("_rgb"))
