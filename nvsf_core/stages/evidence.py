"""Stage `evidence`: what the training sweeps prove about the scene."""

from typing import Any

import numpy as np

from nvsf_core.errors import DataError
from nvsf_core.evidence.moving.object_evidence import ObjectEvidence, boxes_on_way
from nvsf_core.evidence.scene_evidence import SceneEvidence
from nvsf_core.evidence.surfels import Surfels
from nvsf_core.models.proof import prove_scene
from nvsf_core.stages.inputs import read_sweeps
from nvsf_core.stages.runner.stage import Check, StageOutput, Task
from nvsf_core.stores.arrays import write_arrays
from nvsf_core.stores.tables import write_table


def run(task: Task) -> StageOutput:
    """Prove what can be proven from the training sweeps; the stage `evidence`."""
    sweeps = read_sweeps(task.store)
    if sweeps is None:
        write_arrays(task.folder / "evidence.zarr", {})
        write_table(task.folder / "moving.parquet", _moving_boxes((), np.eye(4)))
        return StageOutput(metadata={"evidence": "cameras alone: nothing is proven, everything is learned"})
    if not sweeps.is_training.any():
        raise DataError(
            f"scene {task.scene.name}: expected at least one valid training scan, found none; see in the "
            "table of the stage `frames` why scans are left out, or hold out other frames"
        )
    evidence, tried = prove_scene(sweeps)
    write_arrays(task.folder / "evidence.zarr", evidence.to_arrays())
    scene_to_world = sweeps.trajectory.scene_to_world
    write_table(task.folder / "moving.parquet", _moving_boxes(evidence.objects, scene_to_world))
    surfels = evidence.static
    seen_through = float(surfels.hits[surfels.passes > surfels.hits].sum() / surfels.hits.sum())
    return StageOutput(
        metadata={
            "voxels": len(surfels.hits),
            "voxel_m": surfels.index.voxel_m,
            **_moving(evidence),
            **tried,
            "planar_share": float(surfels.is_planar.mean()),
            "seen_through_share": seen_through,
            **_plane_thickness(surfels),
            "own_vehicle_cells": int((evidence.own_range_m > 0).sum()),
            "unit_gaps_share": 0.0 if evidence.unit_gaps is None else float(evidence.unit_gaps.mean()),
        },
        checks=[
            Check(
                name="most_surfaces_are_planes",
                passed=bool(surfels.is_planar.mean() > 0.2),
                detail=f"{surfels.is_planar.mean():.0%} of {len(surfels.hits)} voxels hold a plane",
            ),
            Check(
                name="most_surfaces_stop_rays",
                passed=seen_through < 0.5,
                detail=f"{seen_through:.0%} of the returns lie in voxels seen through more often than hit; "
                "wrong poses or much motion raise this",
            ),
        ],
    )


def _moving_boxes(objects: tuple[ObjectEvidence, ...], scene_to_world: np.ndarray) -> dict[str, list[Any]]:
    """Columns of `moving.parquet`: the box of each moving object at each scan that saw it."""
    columns: dict[str, list[Any]] = {"object_id": [], "time_s": [], "box_to_world": []}
    for number, one in enumerate(objects, start=1):
        columns["object_id"] += [number] * len(one.path.time_s)
        columns["time_s"] += one.path.time_s.tolist()
        columns["box_to_world"] += (scene_to_world @ boxes_on_way(one)).reshape(-1, 16).tolist()
    return columns


def _plane_thickness(surfels: Surfels) -> dict[str, float]:
    """Metadata with the planes' median thickness; empty if a sparse drive has no plane."""
    if not surfels.is_planar.any():
        return {}
    return {"median_plane_thickness_m": float(np.median(surfels.thickness_m[surfels.is_planar]))}


def _moving(evidence: SceneEvidence) -> dict[str, float]:
    """Metadata: how many objects move, how many of them bend, and their share of the returns."""
    if not evidence.objects:
        return {"moving_objects": 0}
    hits = sum(int(one.rays.is_hit.sum()) for one in evidence.objects)
    return {
        "moving_objects": len(evidence.objects),
        "moving_objects_with_flow": sum(one.flow_m is not None for one in evidence.objects),
        "moving_returns_share": hits / float(hits + evidence.static.hits.sum()),
    }
