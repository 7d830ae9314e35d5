"""What moves, measured: the demo's against its analytic truth, a recorded drive's against its boxes.

Run ``python -m benchmarks.lean.motion [street kitti0005_van_cyclist ...]`` after the stage ``evidence`` of
the scenes; it finds the moving objects anew, to time it. Boxes and truth measure, nothing else reads them.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from nvsf_core.demo.lidar import simulate_scan
from nvsf_core.demo.world import DemoWorld
from nvsf_core.evidence.moving.detection import ABOVE_GROUND_M, find_moving_objects
from nvsf_core.evidence.moving.rigid_path import MovingObject, MovingObjects
from nvsf_core.evidence.moving.timed_returns import TimedReturns
from nvsf_core.evidence.static.ground import build_ground
from nvsf_core.geometry.boxes import inside_any
from nvsf_core.recording.sweeps import Sweeps, training_returns
from nvsf_core.stages.inputs import read_sweeps
from nvsf_core.stores.scene_store import SceneStore
from nvsf_core.stores.tables import read_rows

GROWN_M = 0.3
NEAREST_M, FARTHEST_M = 1.0, 80.0
HEADER = (
    "| scene | what | returns | recall | precision | objects | centre, m a frame: median | rms ahead | aside "
    "| up |"
    "\n|---|---|---|---|---|---|---|---|---|---|"
)


def main() -> None:
    """Print one table for all scenes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="*", default=["street", "kitti0005_van_cyclist"])
    parser.add_argument("--home", type=Path, default=Path(os.environ.get("NVSF_HOME", ".nvsf")))
    asked = parser.parse_args()
    rows, seconds = [], []
    for scene in asked.scenes:
        store = SceneStore(asked.home, scene)
        sweeps = read_sweeps(store)
        if sweeps is None:
            continue
        returns = training_returns(sweeps)
        find_moving_objects(returns)
        started, busy = time.perf_counter(), time.process_time()
        moving = find_moving_objects(returns)
        wall_s, cpu_s = time.perf_counter() - started, time.process_time() - busy
        seconds.append(
            f"{scene}: {wall_s:.1f} s ({cpu_s:.1f} s of CPU) for {returns.scan_count} training scans of "
            f"{len(returns.point_m):,} returns, {os.cpu_count()} cores, {len(moving.objects)} objects"
        )
        measure = _demo_rows if scene in ("demo", "street") else _box_rows
        rows += measure(scene, store, sweeps, returns, moving)
    print(HEADER)
    print("\n".join(rows))
    print("\n" + "\n".join(seconds))


def _demo_rows(
    scene: str, store: SceneStore, sweeps: Sweeps, returns: TimedReturns, moving: MovingObjects
) -> list[str]:
    """Rows of the demo: returns above the ground that truly met a moving object, and those found."""
    world = DemoWorld(0)
    frames = sweeps.arrays["frame"][sweeps.is_training]
    scans = [simulate_scan(world, int(frame), np.arange(64), 2100) for frame in frames]
    if not np.array_equal(np.concatenate([scan.points_m for scan in scans]), returns.recorded_m):
        return [f"| {scene} | the drive is not the full demo: not measured |||||||||"]
    met = np.concatenate([scan.instance for scan in scans])
    to_street = np.linalg.inv(world.street_to_world)
    height = (returns.point_m + sweeps.scene_origin_m) @ to_street[2, :3] + to_street[2, 3]
    above_ground = (height > ABOVE_GROUND_M) & ~returns.is_own_vehicle
    rows = []
    truth = np.zeros(len(met), bool)
    for mover in world.street.movers:
        own = met == mover.object_id
        truth |= own
        best = _most_found(moving, own)
        error = np.zeros((0, 3)) if best is None else _centre_error(
            best, lambda time_s, mover=mover: _mover_centre(world, mover, time_s, sweeps), returns.scan_time_s
        )  # fmt: skip
        rows.append(_row(scene, mover.label, own & above_ground, None, moving, error))
    counted = above_ground & (np.linalg.norm(returns.recorded_m, axis=1) < FARTHEST_M)
    rows.append(_row(scene, "all that moves", truth & counted, counted, moving, np.zeros((0, 3))))
    return rows


def _mover_centre(world: DemoWorld, mover, time_s: np.ndarray, sweeps: Sweeps) -> np.ndarray:  # type: ignore[no-untyped-def]
    pose = world.object_to_world(mover.object_id, time_s)
    return pose[:, :3, 3] + 0.5 * mover.size_m[2] * pose[:, :3, 2] - sweeps.scene_origin_m


def _box_rows(
    scene: str, store: SceneStore, sweeps: Sweeps, returns: TimedReturns, moving: MovingObjects
) -> list[str]:
    """Rows of a recorded drive: returns above the ground in the boxes of what moves, grown by 0.3 m."""
    boxes = [box for box in read_rows(store.require("frames") / "boxes.parquet") if box["dynamic"]]
    frames = sweeps.arrays["frame"][sweeps.is_training]
    range_m = np.linalg.norm(returns.recorded_m, axis=1)
    within = (range_m > NEAREST_M) & (range_m < FARTHEST_M) & ~returns.is_own_vehicle
    above_ground = within & (build_ground(returns.point_m[within]).above(returns.point_m) > ABOVE_GROUND_M)
    rows = []
    for object_id in sorted({box["object_id"] for box in boxes}):
        own, centres, instants = np.zeros(len(above_ground), bool), [], []
        for box in (box for box in boxes if box["object_id"] == object_id and box["frame"] in frames):
            scan = int(np.flatnonzero(frames == box["frame"])[0])
            matrix = np.array(box["box_to_world"]).reshape(4, 4)
            matrix[:3, 3] -= sweeps.scene_origin_m
            own[returns.part(scan)] = inside_any(returns.point_m[returns.part(scan)], matrix[None], GROWN_M)
            centres.append(matrix[:3, 3])
            instants.append(returns.scan_time_s[scan])
        best = _most_found(moving, own)
        known = dict(zip(instants, centres, strict=True))
        error = np.zeros((0, 3)) if best is None else _centre_error(
            best, lambda time_s, known=known: np.array([known[t] for t in time_s]), np.array(instants)
        )  # fmt: skip
        label = next(box["label"] for box in boxes if box["object_id"] == object_id)
        rows.append(_row(scene, label, own & above_ground, None, moving, error))
    return rows


def _most_found(moving: MovingObjects, own: np.ndarray) -> MovingObject | None:
    found = moving.object_id[own & (moving.object_id >= 0)]
    return moving.objects[int(np.bincount(found).argmax())] if len(found) else None


def _centre_error(
    found: MovingObject, centre_at: Callable[[np.ndarray], np.ndarray], time_s: np.ndarray
) -> np.ndarray:
    """How far off (p, 3) ahead, aside, up the found motion takes the centre to the next scan, a frame."""
    time_s = time_s[
        (time_s >= found.time_s[0] - found.frame_s) & (time_s <= found.time_s[-1] + found.frame_s)
    ]
    centre = centre_at(time_s)
    in_object, pose = found.to_object(centre, time_s), found.matrix_at(time_s)
    predicted = np.einsum("nij,nj->ni", pose[1:, :3, :3], in_object[:-1]) + pose[1:, :3, 3]
    frames = np.maximum(np.round(np.diff(time_s) / found.frame_s), 1.0)
    error = (predicted - centre[1:]) / frames[:, None]
    ahead = np.diff(centre[:, :2], axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    along = (error[:, :2] * ahead).sum(axis=1)
    aside = error[:, 1] * ahead[:, 0] - error[:, 0] * ahead[:, 1]
    return np.column_stack([along, aside, error[:, 2]])


def _row(
    scene: str,
    what: str,
    truth: np.ndarray,
    counted: np.ndarray | None,
    moving: MovingObjects,
    error: np.ndarray,
) -> str:
    found = moving.object_id >= 0
    recall = (truth & found).sum() / max(truth.sum(), 1)
    precision = "" if counted is None else f"{(truth & found).sum() / max((found & counted).sum(), 1):.4f}"
    objects = len(np.unique(moving.object_id[truth & found]))
    motion = " | | | "
    if len(error):
        rms = np.sqrt(np.mean(error**2, axis=0))
        median = np.median(np.linalg.norm(error[:, :2], axis=1))
        motion = f"{median:.4f} | {rms[0]:.4f} | {rms[1]:.4f} | {rms[2]:.4f}"
    return f"| {scene} | {what} | {truth.sum():,} | {recall:.4f} | {precision} | {objects} | {motion} |"


if __name__ == "__main__":
    main()
