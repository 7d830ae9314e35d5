"""A drive far from the world's origin, through the real stages: rays, evidence, trained metrics.

Shifts are whole metres, as a scene's origin is. A fraction lays the voxels elsewhere over the street, which
changes metrics by up to twice the seeds' spread (0.06 dB of range PSNR), near as far: a drive moved by
(0.37, 0.81, 0.2) m and by (1000.37, 3700.81, 115.2) m had equal metrics.
"""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.numerics.cases.case import Case, Reading
from benchmarks.numerics.cases.far_poses import FAR_M, KITTI_360_M
from benchmarks.numerics.cases.tolerances import SHIFTED_POSE_M
from nvsf_core.demo.drive import DEMO_SEQUENCE, DemoSize, write_demo
from nvsf_core.drives.catalogue import SceneEntry
from nvsf_core.drives.kitti360.layout import DriveLayout
from nvsf_core.drives.kitti360.writer import write_frame_poses
from nvsf_core.recipe import FieldSpec, TrainingSpec, preset
from nvsf_core.stages import STAGE_NAMES, plan_run, run_named_stage
from nvsf_core.stages.inputs import read_evidence
from nvsf_core.stores.arrays import read_arrays, read_attrs
from nvsf_core.stores.scene_store import SceneStore
from nvsf_core.stores.tables import read_rows

TITLE = "Drives far out, through the stages"
SEEDS = (0, 1, 2)
"""Of the drive where it is; a moved drive is trained with the first."""
_HERE = (0.0, 0.0, 0.0)
_REACH_M = 80.0
_SIZE = replace(DemoSize.tiny(), frames=5, lasers=tuple(range(64)), firings=1050)
"""Whole turns: with thinned ones a range image is mostly empty, and its PSNR says little."""
_HELD_OUT = 2
_RECIPE = replace(
    preset("quick"),
    name="shifted",
    lidar_field=FieldSpec(levels=6, log2_table=14),
    lidar_training=TrainingSpec(steps=300, rays=1024, threads=1),
)
_STAGES = tuple(name for name in STAGE_NAMES if name != "dataset")
_METRICS = (("raw", "chamfer_m2", "m²"), ("raw", "f_score", ""), ("lidar4d", "range_psnr_db", "dB"))
"""Protocol, name and unit: clouds of the sensor's own rays, and the papers' range image."""


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """What the stages made of a drive; positions are scene-local."""

    scene_origin_m: np.ndarray
    origin_m: np.ndarray
    end_m: np.ndarray
    """`_REACH_M` along each ray."""
    range_m: np.ndarray
    surfel_m: np.ndarray
    hits: np.ndarray
    metrics: np.ndarray
    """(seeds, metrics) of the held-out frame."""


def move_poses(layout: DriveLayout, shift_m: Sequence[float]) -> None:
    """Write a drive's poses anew, all moved by a constant; the camera's own file of them is removed."""
    rows = np.loadtxt(layout.poses_path, ndmin=2)
    poses = rows[:, 1:].reshape(-1, 3, 4)
    poses[:, :, 3] += shift_m
    write_frame_poses(layout.poses_path, rows[:, 0].astype(int).tolist(), poses, rows=3)
    layout.cam0_to_world_path.unlink()


@cache
def _found(shift_m: tuple[float, float, float]) -> _Found:
    """Write, move and train the drive, once in a run of the table and in a folder that goes away."""
    seeds = SEEDS if shift_m == _HERE else SEEDS[:1]
    with TemporaryDirectory(prefix="nvsf_shifted_") as folder:
        root, home = Path(folder) / "drive", Path(folder) / "home"
        write_demo(root, size=_SIZE)
        layout = DriveLayout(root, DEMO_SEQUENCE)
        shutil.rmtree(root / "data_2d_raw")
        layout.perspective_path.unlink()
        move_poses(layout, shift_m)
        scene = SceneEntry(
            name="shifted", root=root, sequence=DEMO_SEQUENCE, first_frame=0, last_frame=_SIZE.frames - 1,
            test_frames=(_HELD_OUT,),
        )  # fmt: skip
        metrics = []
        for seed in seeds:
            run = plan_run(scene, home, recipe=_RECIPE, seed=seed)
            for name in _STAGES:
                run_named_stage(name, run, lambda _: None)
            metrics.append(_metrics(home / scene.name / "scene_metrics" / _RECIPE.name / str(seed)))
        return _geometry(SceneStore(home, scene.name), np.array(metrics))


def _metrics(folder: Path) -> list[float]:
    """The trained recipe's, in the order of `_METRICS`; the baselines stand beside it under their names."""
    rows = read_rows(folder / "metrics.parquet")
    return [
        next(
            row["value"]
            for row in rows
            if (row["protocol"], row["metric"], row["region"], row["recipe"], row["frame"])
            == (protocol, metric, "all", _RECIPE.name, _HELD_OUT)
        )
        for protocol, metric, _ in _METRICS
    ]


def _geometry(store: SceneStore, metrics: np.ndarray) -> _Found:
    returns = store.require("sweeps") / "returns.zarr"
    arrays = read_arrays(returns, "origin_m", "direction", "range_m")
    evidence = read_evidence(store)
    if evidence is None:
        raise RuntimeError("expected evidence of a drive with scans, found none")
    return _Found(
        scene_origin_m=np.array(read_attrs(returns)["scene_origin_m"]),
        origin_m=arrays["origin_m"].astype(np.float64),
        end_m=arrays["origin_m"].astype(np.float64) + _REACH_M * arrays["direction"].astype(np.float64),
        range_m=arrays["range_m"],
        surfel_m=evidence.static.surfels.mean_m.astype(np.float64),
        hits=evidence.static.surfels.hits,
        metrics=metrics,
    )


def _rays(shift_m: tuple[float, float, float]) -> Reading:
    near, far = _found(_HERE), _found(shift_m)
    back_m = far.scene_origin_m - near.scene_origin_m - shift_m
    same = len(near.end_m) == len(far.end_m) and np.array_equal(near.range_m, far.range_m)
    error = float("inf")
    if same:
        sides = ((near.origin_m, far.origin_m), (near.end_m, far.end_m))
        error = max(float(np.abs(moved + back_m - still).max()) for still, moved in sides)
    return Reading(
        error=error, limit=SHIFTED_POSE_M, unit="m", is_refuted=not same,
        outcome=f"{len(near.end_m)} and {len(far.end_m)} rays: origins, and {_REACH_M:.0f} m along; "
        f"measured ranges {'bit-equal' if same else 'differ'}",
    )  # fmt: skip


def _evidence(shift_m: tuple[float, float, float]) -> Reading:
    near, far = _found(_HERE), _found(shift_m)
    back_m = far.scene_origin_m - near.scene_origin_m - shift_m
    same = len(near.hits) == len(far.hits) and np.array_equal(near.hits, far.hits)
    error = float(np.abs(far.surfel_m + back_m - near.surfel_m).max()) if same else float("inf")
    return Reading(
        error=error, limit=SHIFTED_POSE_M, unit="m", is_refuted=not same,
        outcome=f"{len(near.hits)} and {len(far.hits)} surfels, hits {'equal' if same else 'differ'}",
    )  # fmt: skip


def _trained(shift_m: tuple[float, float, float]) -> Reading:
    still, moved = _found(_HERE).metrics, _found(shift_m).metrics[0]
    spread = np.ptp(still, axis=0)
    share = np.abs(moved - still[0]) / spread
    said = [
        f"{metric} {value:.4f} {unit}".rstrip()
        + f" ({first:.4f} where it is, {low:.4f} to {high:.4f} over {len(SEEDS)} seeds)"
        for (_, metric, unit), value, first, low, high in zip(
            _METRICS, moved, still[0], still.min(axis=0), still.max(axis=0), strict=True
        )
    ]
    return Reading(error=float(share.max()), limit=1.0, unit="of the seeds' spread", outcome="; ".join(said))


CASES = tuple(
    Case(function, f"demo, {_SIZE.frames} frames, moved by {name}, whole metres", partial(check, shift))
    for name, shift in (("3.8 km", KITTI_360_M), ("5e6 m along each axis", FAR_M))
    for function, check in (
        ("stages.sweeps", _rays),
        ("stages.evidence", _evidence),
        ("stages.field to stages.scene_metrics", _trained),
    )
)
