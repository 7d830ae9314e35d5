"""Stage `evidence`: what the training sweeps prove about the scene."""

import numpy as np

from nvsf_core._types import Scalar
from nvsf_core.errors import DataError
from nvsf_core.evidence.profile import scene_profile
from nvsf_core.evidence.scene_evidence import SceneEvidence
from nvsf_core.evidence.surfels import Surfels
from nvsf_core.models.proof import prove_scene
from nvsf_core.recording.drive import Sweeps
from nvsf_core.stages.inputs import read_sweeps
from nvsf_core.stages.runner.stage import Check, Stage, StageOutput, Task
from nvsf_core.stores.arrays import write_arrays
from nvsf_core.stores.tables import read_rows, write_table


def _run(task: Task) -> StageOutput:
    sweeps = read_sweeps(task.store)
    if sweeps is None:
        write_arrays(task.folder / "evidence.zarr", {})
        return StageOutput(metadata={"profile": "cameras alone: nothing is proven, everything is learned"})
    if not sweeps.is_training.any():
        raise DataError(
            f"scene {task.scene.name}: expected at least one valid training scan, found none; see in the "
            "table of the stage `frames` why scans are left out, or hold out other frames"
        )
    evidence, tried = prove_scene(sweeps)
    write_arrays(task.folder / "evidence.zarr", evidence.to_arrays())
    surfels = evidence.surfels
    profile = _profile(evidence, sweeps, task)
    write_table(task.folder / "profile.parquet", {name: [value] for name, value in profile.items()})
    seen_through = float(surfels.hits[surfels.passes > surfels.hits].sum() / surfels.hits.sum())
    return StageOutput(
        metadata={
            **profile,
            **tried,
            "planar_share": float(surfels.is_planar.mean()),
            "seen_through_share": seen_through,
            **_plane_thickness(surfels),
            "unknown_voxels": 0 if evidence.unobserved is None else len(evidence.unobserved.hits),
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


def _plane_thickness(surfels: Surfels) -> dict[str, float]:
    """Metadata with the planes' median thickness; empty if a sparse drive has no plane."""
    if not surfels.is_planar.any():
        return {}
    return {"median_plane_thickness_m": float(np.median(surfels.thickness_m[surfels.is_planar]))}


def _profile(evidence: SceneEvidence, sweeps: Sweeps, task: Task) -> dict[str, Scalar]:
    """The scene's profile: its properties in words and numbers."""
    cameras = read_rows(task.store.require("frames") / "cameras.parquet")
    names = sorted({row["camera"] for row in cameras if row["image_valid"]})
    times_s = sweeps.arrays["time_s"][sweeps.is_training]
    return scene_profile(evidence, names, float(times_s.max() - times_s.min()))


STAGE = Stage(
    name="evidence",
    group="prepare",
    inputs=("frames", "sweeps"),
    description="What the training sweeps prove without learning: surfels in voxels, see-throughs, "
    "hit priors, the own vehicle, what moves and how, and what the scene needs.",
    version="14",
    run=_run,
)
