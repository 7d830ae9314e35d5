"""The exact motion of each return of the demo drive, from the demo's formulas."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from nvsf_core.demo.motion import FRAME_PERIOD_S
from nvsf_core.demo.world import DemoWorld
from nvsf_core.geometry.bounds import Bounds
from nvsf_core.geometry.se3 import pose_from_parts, transform_points
from nvsf_core.models.paper.flow_training import flow_cloud
from nvsf_core.recording.drive import Sweeps
from nvsf_core.stages.scoring.demo_truth import DemoTruth

SURFACES = ("car", "cyclist", "static", "ground")
"""The two that move; what stands, in the clouds; the street, which the clouds leave out."""
_MOVERS = {1: "car", 2: "cyclist"}
_SAME_SURFACE_M = 0.1
"""A return farther than this from the exact hit mixes two surfaces and has no motion of its own."""
_BOX_POINTS_STEP = 7
_GROUND_STEP = 50


@dataclass(frozen=True, slots=True, eq=False)
class TrueMotion:
    """One scan, and where its points are a frame later and earlier."""

    frame: int
    is_training: bool
    cloud_m: np.ndarray
    """(m, 3) float32, from the scene's centre: what the flow is compared on."""
    points_m: np.ndarray
    """(n, 3) float32, from the scene's centre: points with a known motion."""
    surface: np.ndarray
    """(n,) index into `SURFACES`."""
    following_m: np.ndarray
    """(n, 3) displacement within one frame period, metres."""
    preceding_m: np.ndarray
    """(n, 3) the same back in time."""


def scene_cube(sweeps: Sweeps) -> Bounds:
    """The cube around the training scans' returns, as training the recipe `paper` has it."""
    training = np.repeat(sweeps.is_training, np.diff(sweeps.arrays["offsets"]))
    kept = training & (sweeps.arrays["range_m"] < sweeps.table.max_range_m)
    return Bounds.of_points(_points(sweeps, slice(None))[kept][::_BOX_POINTS_STEP])


def true_motions(sweeps: Sweeps, truth: DemoTruth, bounds: Bounds) -> list[TrueMotion]:
    """Every scan of the drive, held-out ones included."""
    draws = np.random.default_rng(0)
    return [_motion(sweeps, truth, bounds, scan, draws) for scan in range(sweeps.count)]


def _motion(
    sweeps: Sweeps, truth: DemoTruth, bounds: Bounds, scan: int, draws: np.random.Generator
) -> TrueMotion:
    part, a, world = sweeps.returns_of(scan), sweeps.arrays, truth.world
    points_m, centre_m = _points(sweeps, part), np.array(bounds.centre_m)
    near = np.flatnonzero(a["range_m"][part] < sweeps.table.max_range_m)
    pose = pose_from_parts(*sweeps.trajectory.at(a["time_s"][scan : scan + 1]))[0]
    cloud_m = flow_cloud(points_m[near], pose, centre_m, draws)
    centred = (points_m - centre_m).astype(np.float32)
    in_cloud = near[cKDTree(centred[near]).query(cloud_m)[1]]

    times_s = (
        a["time_s"][scan] + truth.shift_s + truth.period_s * a["sweep_fraction"][part].astype(np.float64)
    )
    scene_to_world = sweeps.trajectory.scene_to_world
    origin_m = transform_points(scene_to_world, a["origin_m"][part])
    direction = a["direction"][part].astype(np.float64) @ scene_to_world[:3, :3].T
    exact = world.cast(origin_m, direction, times_s)
    known = np.abs(exact.range_m - a["range_m"][part]) < _SAME_SURFACE_M
    known &= ~a["is_own_vehicle"][part]
    ground = np.flatnonzero(known & (exact.instance == 0))[::_GROUND_STEP]
    # The street's few points that stay in the clouds are neither: what stands is more than 0.
    above = in_cloud[known[in_cloud] & (exact.instance[in_cloud] > 0)]
    chosen = np.concatenate([above, ground])
    instance, surface = exact.instance[chosen], np.full(len(chosen), SURFACES.index("static"))
    surface[instance == 0] = SURFACES.index("ground")
    for number, name in _MOVERS.items():
        surface[instance == number] = SURFACES.index(name)
    in_world_m = transform_points(scene_to_world, points_m[chosen])
    moved = [
        displacements_m(world, in_world_m, times_s[chosen], instance, after_s) @ scene_to_world[:3, :3]
        for after_s in (FRAME_PERIOD_S, -FRAME_PERIOD_S)
    ]
    return TrueMotion(
        int(a["frame"][scan]), bool(sweeps.is_training[scan]), cloud_m, centred[chosen], surface, *moved
    )


def displacements_m(
    world: DemoWorld, points_m: np.ndarray, times_s: np.ndarray, instance: np.ndarray, after_s: float
) -> np.ndarray:
    """Displacements (n, 3) in metres of points that are rigidly tied to what they lie on.

    Args:
        world: The demo's.
        points_m: (n, 3) in the world.
        times_s: (n,) when they are there.
        instance: (n,) what they lie on.
        after_s: How much later is asked about; negative = earlier.
    """
    moved = np.zeros_like(points_m)
    for number in _MOVERS:
        on = np.flatnonzero(instance == number)
        if not len(on):
            continue
        now, then = (world.object_to_world(number, times_s[on] + later) for later in (0.0, after_s))
        own = np.einsum("nji,nj->ni", now[:, :3, :3], points_m[on] - now[:, :3, 3])
        moved[on] = np.einsum("nij,nj->ni", then[:, :3, :3], own) + then[:, :3, 3] - points_m[on]
    return moved


def _points(sweeps: Sweeps, part: slice) -> np.ndarray:
    """Returns (n, 3) float64, scene-local."""
    a = sweeps.arrays
    along = a["direction"][part] * a["range_m"][part].astype(np.float64)[:, None]
    points: np.ndarray = a["origin_m"][part].astype(np.float64) + along
    return points
