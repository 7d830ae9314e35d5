"""A drive far from the world's origin, through the real stages: rays, evidence, trained metrics.

Shifts are whole metres, as a scene's origin is. A fraction lays the voxels elsewhere over the street, which
changes metrics by up to twice the seeds' spread (0.06 dB of range PSNR), near as far: a drive moved by
(0.37, 0.81, 0.2) m and by (1000.37, 3700.81, 115.2) m had equal metrics.
"""

import shutil
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.numerics.cases.case import Case, Reading, largest
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
_SHIFTS_M = {"3.8 km": (1_000.0, 3_700.0, 115.0), "5e6 m along each axis": (5e6, -5e6, 5e6)}
"""Where the first sweep of both real drives lies, in KITTI-360's coordinates; as in UTM."""
_SIZE = replace(DemoSize.tiny(), frames=5, lasers=tuple(range(64)), firings=1050)
"""Whole turns: with thinned ones a range image is mostly empty, and its PSNR says little."""
_HELD_OUT = 2
_TRAINING = TrainingSpec(steps=300, rays=1024)
_FIELD = FieldSpec(levels=6, log2_table=14)
_RECIPE = replace(preset("quick"), name="shifted", lidar_field=_FIELD, lidar_training=_TRAINING)
_METRICS = (("raw", "chamfer_m2"), ("raw", "f_score"), ("lidar4d", "range_psnr_db"))
"""Of the sensor's own rays, and of the papers' range image."""


def _write(root: Path, shift_m: tuple[float, ...]) -> SceneEntry:
    """A drive without images, its poses moved by a constant."""
    write_demo(root, size=_SIZE)
    layout = DriveLayout(root, DEMO_SEQUENCE)
    shutil.rmtree(root / "data_2d_raw")
    layout.perspective_path.unlink()
    layout.cam0_to_world_path.unlink()
    rows = np.loadtxt(layout.poses_path, ndmin=2)
    poses = rows[:, 1:].reshape(-1, 3, 4)
    poses[:, :, 3] += shift_m
    write_frame_poses(layout.poses_path, rows[:, 0].astype(int).tolist(), poses, rows=3)
    last, held_out = _SIZE.frames - 1, (_HELD_OUT,)
    return SceneEntry(
        name="far", root=root, sequence=DEMO_SEQUENCE, first_frame=0, last_frame=last, test_frames=held_out
    )


@cache
def _found(shift_m: tuple[float, ...]) -> dict[str, np.ndarray]:
    """What the stages make of the drive, moved back; once a run, in a folder that goes away."""
    with TemporaryDirectory(prefix="nvsf_shifted_") as folder:
        scene = _write(Path(folder) / "drive", shift_m)
        run = plan_run(scene, Path(folder), recipe=_RECIPE, seed=0)
        for name in STAGE_NAMES:
            if name != "dataset":
                run_named_stage(name, run, lambda _: None)
        store = SceneStore(Path(folder), scene.name)
        returns, evidence = store.require("sweeps") / "returns.zarr", read_evidence(store)
        assert evidence is not None, "no evidence of a drive with scans"
        back_m = np.array(read_attrs(returns)["scene_origin_m"]) - shift_m
        arrays = read_arrays(returns, "origin_m", "direction", "range_m")
        starts = arrays["origin_m"].astype(np.float64) + back_m
        ends = starts + 80.0 * arrays["direction"].astype(np.float64)
        surfels = evidence.static
        rows = read_rows(Path(folder) / scene.name / "scene_metrics" / "shifted" / "0" / "metrics.parquet")
        # The baselines stand beside the trained recipe under their names.
        of = {(r["protocol"], r["metric"], r["region"], r["recipe"], r["frame"]): r["value"] for r in rows}
        return {
            "rays": np.column_stack([starts, ends, arrays["range_m"]]),
            "surfels": np.column_stack([surfels.mean_m + back_m, surfels.hits]),
            "metrics": np.array([of[*name, "all", "shifted", _HELD_OUT] for name in _METRICS]),
        }


def _compared(what: str, shift_m: tuple[float, ...]) -> Reading:
    still, moved = _found((0.0, 0.0, 0.0))[what], _found(shift_m)[what]
    said = f"{len(still)} {what}" if what != "metrics" else f"{moved.round(4)}, where it is {still.round(4)}"
    return Reading(error=largest(moved, still), outcome=said)


CASES = tuple(
    Case(stage, f"demo, 5 frames, moved by {name}: {words}", partial(_compared, what, by), limit, unit)
    for name, by in _SHIFTS_M.items()
    for stage, what, words, limit, unit in (
        ("stages.sweeps", "rays", "starts, 80 m along, and ranges of rays", SHIFTED_POSE_M, "m"),
        ("stages.evidence", "surfels", "means of surfels, and their hits", SHIFTED_POSE_M, "m"),
        ("stages.field to scene_metrics", "metrics", "Chamfer distance, F, range PSNR", 1e-5, "m², 1, dB"),
    )
)  # fmt: skip
