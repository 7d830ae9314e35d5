"""Stage `pano`: recorded scans as range images, on the papers' linear grid and with one row per laser."""

from typing import Any

import numpy as np

from nvsf_core._types import Scalar
from nvsf_core.metrics.point_cloud import point_cloud_metrics
from nvsf_core.reporting.previews import range_preview
from nvsf_core.sensors.beam_table import BeamPano
from nvsf_core.sensors.linear_pano import LinearPano
from nvsf_core.sensors.tables import LaserTable, recorded_table
from nvsf_core.stages.runner.heartbeat import sparse
from nvsf_core.stages.runner.stage import Check, StageOutput, Task
from nvsf_core.stores.arrays import read_arrays, read_attrs, write_arrays

ARRAYS_NAME = "pano.zarr"

_ROUND_TRIP_SCANS = 3
"""Number of scans whose round trip is measured: a KD-tree of 120,000 points takes half a second."""


def run(task: Task) -> StageOutput:
    """Project each recorded scan; the stage `pano`."""
    source = task.store.require("sweeps") / "returns.zarr"
    returns = read_arrays(source, "frame", "offsets", "points_m", "intensity", "laser")
    attrs = read_attrs(source)
    table = recorded_table(attrs)
    linear = LinearPano()
    beam = BeamPano(table, linear.width) if bool((returns["laser"] >= 0).any()) else None
    arrays = _project_all(task, returns, linear, beam)
    write_arrays(task.folder / ARRAYS_NAME, arrays, _attrs(linear, table))
    output = StageOutput(metadata={"scans": len(returns["frame"])})
    if len(returns["frame"]) == 0:
        return output
    _measure(output, returns, arrays, linear, beam)
    middle = len(returns["frame"]) // 2
    for name in ("linear", "beam") if beam else ("linear",):
        file_name = f"{name}_range.png"
        (task.folder / file_name).write_bytes(range_preview(arrays[f"{name}_range_m"][middle]))
        output.previews[f"{name}_range"] = file_name
    return output


def _project_all(
    task: Task, returns: dict[str, np.ndarray], linear: LinearPano, beam: BeamPano | None
) -> dict[str, np.ndarray]:
    n = len(returns["frame"])
    arrays = {"frame": returns["frame"]}
    shapes = {"linear": (linear.height, linear.width)}
    if beam:
        shapes["beam"] = (beam.table.laser_count, beam.width)
    for name, shape in shapes.items():
        arrays[f"{name}_range_m"] = np.zeros((n, *shape), np.float32)
        arrays[f"{name}_intensity"] = np.zeros((n, *shape), np.float32)
    say = sparse(task.progress)
    for k in range(n):
        part = slice(returns["offsets"][k], returns["offsets"][k + 1])
        points_m, intensity = returns["points_m"][part], returns["intensity"][part]
        arrays["linear_range_m"][k], arrays["linear_intensity"][k] = linear.project(points_m, intensity)
        if beam:
            images = beam.project(points_m, intensity, returns["laser"][part])
            arrays["beam_range_m"][k], arrays["beam_intensity"][k] = images
        say(f"[{task.scene.name}] pano: projected {k + 1} of {n} scans")
    return arrays


def _measure(
    output: StageOutput,
    returns: dict[str, np.ndarray],
    arrays: dict[str, np.ndarray],
    linear: LinearPano,
    beam: BeamPano | None,
) -> None:
    """Measure some scans' round trip through each grid, against the raw scan within the grid's range."""
    n = len(returns["frame"])
    chosen = np.unique(np.linspace(0, n - 1, min(n, _ROUND_TRIP_SCANS)).astype(np.int64))
    grids: dict[str, LinearPano | BeamPano] = {"linear": linear}
    if beam:
        grids["beam"] = beam
    found: dict[str, Scalar] = {"linear_held_share": _held_share(returns, linear)}
    for name, grid in grids.items():
        values: dict[str, list[float]] = {"chamfer_m2": [], "f_score": []}
        for k in chosen:
            raw_m = returns["points_m"][returns["offsets"][k] : returns["offsets"][k + 1]].astype(np.float64)
            raw_m = raw_m[np.linalg.norm(raw_m, axis=1) < grid.max_range_m]
            measured = point_cloud_metrics(grid.points(arrays[f"{name}_range_m"][k]), raw_m)
            for metric, numbers in values.items():
                numbers.append(measured[metric].value)
        for metric, numbers in values.items():
            found[f"{name}_round_trip_{metric}"] = float(np.mean(numbers))
        found[f"{name}_filled_share"] = float((arrays[f"{name}_range_m"] > 0.0).mean())
    output.metadata.update(found)
    output.metadata["round_trip_scans"] = len(chosen)
    if beam:
        linear_m2, beam_m2 = found["linear_round_trip_chamfer_m2"], found["beam_round_trip_chamfer_m2"]
        output.checks.append(
            Check(
                name="beam_grid_beats_linear_grid",
                passed=float(beam_m2) < float(linear_m2),
                detail=f"Chamfer to the raw scan: {linear_m2:.4f} m2 linear, {beam_m2:.4f} m2 on the lasers",
            )
        )


def _held_share(returns: dict[str, np.ndarray], linear: LinearPano) -> float:
    """Share of the returns within the grid's range that lie between its upper and its lower edge.

    The grid is the HDL-64E's: other sensors also look above or below it, and `paper` does not learn that.
    """
    _, _, range_m, is_held = linear.cells(returns["points_m"])
    return float(is_held.sum() / max(1, (range_m < linear.max_range_m).sum()))


def _attrs(linear: LinearPano, table: LaserTable) -> dict[str, Any]:
    """Attributes that a reader needs to convert the images back to points."""
    return {
        "linear": {
            "height": linear.height, "width": linear.width, "fov_up_deg": linear.fov_up_deg,
            "fov_deg": linear.fov_deg, "max_range_m": linear.max_range_m, "quirks": linear.reference_quirks,
        },
        "sensor": table.name,
        "elevation_rad": table.elevation_rad.tolist(),
        "vertical_offset_m": table.vertical_offset_m.tolist(),
        "horizontal_offset_m": table.horizontal_offset_m.tolist(),
        "phase_steps": table.phase_steps.tolist(),
    }  # fmt: skip
