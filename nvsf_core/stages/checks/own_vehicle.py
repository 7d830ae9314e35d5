"""Check of stored views for ghosts of the recording vehicle: returns where only it itself ever was."""

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np

from nvsf_core.geometry.se3 import poses_in
from nvsf_core.sensors.own_vehicle import NEAR_M
from nvsf_core.stages.checks.declared import GHOSTS
from nvsf_core.stages.checks.norms import training_frames
from nvsf_core.stages.inputs import scene_frame
from nvsf_core.stages.runner.stage import Check, Task
from nvsf_core.stores.arrays import holds_array, read_arrays, read_attrs

_CUBE_M, _STEP_M = 0.2, 0.1
_BESIDE = np.stack(np.meshgrid(*[np.arange(-1, 2)] * 3), axis=-1).reshape(-1, 3)
_STRIDE = 1 << 20
_TWICE, _SPARE = 2.0, 5e-4


def check_ghosts(task: Task) -> list[Check]:
    """The outcome of `GHOSTS` for the model's scans of all views in the task's folder."""
    recorded = task.store.require("sweeps") / "returns.zarr"
    if read_arrays(recorded, "frame")["frame"].size == 0:
        return [GHOSTS.not_run("this drive has no LiDAR")]
    a = read_arrays(recorded, "frame", "offsets", "points_m", "lidar_to_world", "is_own_vehicle")
    if not a["is_own_vehicle"].any():
        return [GHOSTS.not_run("no recorded return is on the recording vehicle")]
    scene_to_world = scene_frame(read_attrs(recorded))
    a["pose"] = poses_in(scene_to_world, a["lidar_to_world"])
    swept = _swept_cubes(a["points_m"][a["is_own_vehicle"]], a["pose"])
    training = np.flatnonzero(np.isin(a["frame"], training_frames(task.store)))
    usual = max((share for _, share in _shares(a, swept, training)), default=0.0)
    found = [
        (share, f"view {path.parent.name}, frame {frame}")
        for path in sorted(task.folder.glob("*/model.zarr"))
        if holds_array(path, "points_m")
        for frame, share in _of_view(path, swept, scene_to_world)
    ]
    if not found:
        return [GHOSTS.not_run("no view has a scan")]
    worst, place = max(found)
    detail = f"{worst:.3%} of the returns of {place}; of recorded scans at most {usual:.3%}"
    return [GHOSTS.outcome(worst, _TWICE * usual + _SPARE, detail)]


def _of_view(path: Path, swept: np.ndarray, scene_to_world: np.ndarray) -> Iterator[tuple[int, float]]:
    a = read_arrays(path, "frame", "offsets", "points_m", "lidar_to_world")
    a["pose"] = poses_in(scene_to_world, a["lidar_to_world"])
    yield from _shares(a, swept, np.arange(len(a["frame"])))


def _shares(a: dict[str, np.ndarray], swept: np.ndarray, scans: np.ndarray) -> Iterator[tuple[int, float]]:
    """Frame and share of the returns in `swept` of some scans; points are moved by their scan's pose."""
    for scan in scans.tolist():
        points_m = a["points_m"][a["offsets"][scan] : a["offsets"][scan + 1]].astype(np.float64)
        far_m = points_m[np.linalg.norm(points_m, axis=1) > NEAR_M]
        pose = a["pose"][scan]
        inside = np.isin(_numbers(far_m @ pose[:3, :3].T + pose[:3, 3]), swept)
        yield int(a["frame"][scan]), float(inside.sum() / max(1, len(points_m)))


def _swept_cubes(own_m: np.ndarray, lidar_to_scene: np.ndarray) -> np.ndarray:
    """Numbers of the cubes of the scene through which the vehicle's own returns (n, 3) were carried.

    Between the poses (m, 4, 4), in order of time, the vehicle drives straight on.
    """
    # With the cubes beside them: surfaces made of such returns are as wide as voxels.
    cube = np.unique(np.floor(own_m.astype(np.float64) / _CUBE_M), axis=0)
    parts = np.unique((cube[:, None] + _BESIDE).reshape(-1, 3), axis=0) * _CUBE_M + 0.5 * _CUBE_M
    cubes = [_numbers(parts @ pose[:3, :3].T + pose[:3, 3]) for pose in lidar_to_scene[-1:]]
    for pose, after in pairwise(lidar_to_scene):
        way_m = after[:3, 3] - pose[:3, 3]
        steps = int(np.ceil(np.linalg.norm(way_m) / _STEP_M)) + 1
        along_m = np.linspace(0.0, 1.0, steps)[:, None] * way_m
        placed = parts @ pose[:3, :3].T + pose[:3, 3]
        cubes.append(np.unique(_numbers((placed[None] + along_m[:, None]).reshape(-1, 3))))
    return np.unique(np.concatenate(cubes))


def _numbers(points_m: np.ndarray) -> np.ndarray:
    """(n,) int64 number of the cube of each point (n, 3), scene-local metres; equal only near each other."""
    cube = np.floor(points_m / _CUBE_M).astype(np.int64) % _STRIDE
    found: np.ndarray = (cube[:, 0] * _STRIDE + cube[:, 1]) * _STRIDE + cube[:, 2]
    return found
