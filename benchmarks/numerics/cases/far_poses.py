"""Poses far from the world's origin: rays and evidence must not notice."""

from functools import partial

import numpy as np

from benchmarks.numerics.cases.case import Case, Reading, refused
from benchmarks.numerics.cases.tolerances import SHIFTED_POSE_M
from nvsf_core.errors import DataError
from nvsf_core.evidence.static.surfels import Surfels, build_surfels, candidates_of
from nvsf_core.geometry.se3 import exp_se3, interpolate_poses, invert_pose
from nvsf_core.sensors.beam_table import sensor_rays
from nvsf_core.sensors.sweep import Trajectory, compensate
from nvsf_core.sensors.tables import HDL_64E
from nvsf_core.simulation.scan import sweep_rays

TITLE = "Poses far out"
KITTI_360_M = (1_000.0, 3_700.0, 115.0)
"""Where the first sweep of both real drives lies, in KITTI-360's coordinates: 3.8 km from the origin."""
FAR_M = (5e6, -5e6, 5e6)
"""As in UTM, and 8,660 km from the origin."""
_PERIOD_S = 0.1


def drive(shift_m: tuple[float, float, float], frames: int = 6) -> Trajectory:
    """A curve at 12 m/s, its poses and its scene's origin moved by a constant."""
    start = exp_se3(np.array([0.0, 0.0, 0.0, 0.01, -0.02, 0.7]))
    step = exp_se3(np.array([1.2, 0.05, 0.01, 0.001, 0.002, 0.03]))
    poses = [start]
    for _ in range(frames - 1):
        poses.append(poses[-1] @ step)
    moved = np.stack(poses)
    moved[:, :3, 3] += np.array(shift_m)
    return Trajectory(np.arange(frames) * _PERIOD_S, moved, np.round(moved[frames // 2, :3, 3]))


def _origin_shift(shift_m: tuple[float, float, float]) -> np.ndarray:
    """Scene-local coordinates of a shifted drive minus those of the unshifted one: whole metres' rounding."""
    difference: np.ndarray = (
        drive(shift_m).scene_origin_m - drive((0.0, 0.0, 0.0)).scene_origin_m - np.array(shift_m)
    )
    return difference


def _scan(frames: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    azimuth = rng.uniform(-np.pi, np.pi, 3000)
    laser = rng.integers(0, 64, 3000)
    origin, direction = sensor_rays(HDL_64E, azimuth, laser)
    ranges = rng.uniform(2.0, 80.0, 3000)
    return origin + direction * ranges[:, None], laser, -azimuth / (2 * np.pi)


def _rays(shift_m: tuple[float, float, float]) -> Reading:
    points, laser, fraction = _scan(6)
    near, far = drive((0.0, 0.0, 0.0)), drive(shift_m)
    offset = _origin_shift(shift_m)
    worst = 0.0
    for frame in range(6):
        time_s = frame * _PERIOD_S + fraction * _PERIOD_S
        a = compensate(HDL_64E, points, laser, time_s, near)
        b = compensate(HDL_64E, points, laser, time_s, far)
        ends = [rays[0] + rays[1] * rays[2][:, None] for rays in (a, b)]
        worst = max(worst, float(np.abs(ends[1] + offset - ends[0]).max()))
    return Reading(error=worst, limit=SHIFTED_POSE_M, unit="m", outcome="end points 2 to 80 m from the car")


def _simulated(shift_m: tuple[float, float, float]) -> Reading:
    sides = [
        sweep_rays(HDL_64E, np.arange(64), 300, drive(shift), 0.2, _PERIOD_S)
        for shift in ((0.0, 0.0, 0.0), shift_m)
    ]
    offset = _origin_shift(shift_m)
    ends = [side.origin_m.astype(np.float64) + 80.0 * side.direction for side in sides]
    return Reading(
        error=float(np.abs(ends[1] + offset - ends[0]).max()), limit=SHIFTED_POSE_M, unit="m",
        outcome="80 m along each ray, float32",
    )  # fmt: skip


def _street(trajectory: Trajectory, offset: np.ndarray) -> tuple[Surfels, np.ndarray, np.ndarray]:
    """Surfels of a ground and two walls from all frames, and the rays they came from."""
    rng = np.random.default_rng(1)
    azimuth, laser = rng.uniform(-np.pi, np.pi, 20_000), rng.integers(0, 64, 20_000)
    origin_s, direction_s = sensor_rays(HDL_64E, azimuth, laser)
    parts = []
    for frame in range(len(trajectory.times_s)):
        when = np.full(len(azimuth), frame * _PERIOD_S) - azimuth / (2 * np.pi) * _PERIOD_S
        origin, direction = trajectory.move_rays(origin_s, direction_s, when)
        with np.errstate(divide="ignore"):
            ground = (-1.73 - (origin + offset)[:, 2]) / direction[:, 2]
            walls = (8.1 * np.sign(direction[:, 1]) - (origin + offset)[:, 1]) / direction[:, 1]
        ranges = np.minimum(*(np.where(r > 0.5, r, np.inf) for r in (ground, walls)))
        kept = ranges < 60.0
        parts.append((origin[kept], direction[kept], ranges[kept]))
    origins, directions, ranges = (np.concatenate(column) for column in zip(*parts, strict=True))
    surfels = build_surfels(
        origins, directions, ranges, np.ones(len(ranges), np.float32), voxel_m=0.25, threads=1
    )
    return surfels, origins, directions


def _evidence(shift_m: tuple[float, float, float]) -> Reading:
    """Ranges that evidence proposes on the same rays, with and without the shift."""
    rendered = []
    for shift in ((0.0, 0.0, 0.0), shift_m):
        offset = _origin_shift(shift)
        surfels, origins, directions = _street(drive(shift), offset)
        chosen = slice(0, None, 40)
        found = candidates_of(surfels, origins[chosen], directions[chosen], most=4, near_m=0.5, far_m=80.0)
        rendered.append((found.range_m[:, 0], len(surfels.hits), found.voxel[:, 0] >= 0))
    (near, n_near, there), (far, n_far, also) = rendered
    wrong = np.abs(near - far)
    share = float((wrong > SHIFTED_POSE_M).mean())
    return Reading(
        error=float(np.quantile(wrong, 0.999)), limit=SHIFTED_POSE_M, unit="m (99.9 % of rays)",
        outcome=f"{n_near} and {n_far} voxels; {share:.2%} of rays differ more: they cross a voxel border",
        is_refuted=bool((there != also).any()) or abs(n_near - n_far) > 1e-3 * n_near,
    )  # fmt: skip


def _between(shift_m: tuple[float, float, float]) -> Reading:
    """Interpolating the world's poses themselves: what 5e6 m cost in float64."""
    first, second = np.eye(4), exp_se3(np.array([1.2, 0.0, 0.0, 0.0, 0.0, 0.03]))
    far = [pose.copy() for pose in (first, second)]
    for pose in far:
        pose[:3, 3] += np.array(shift_m)
    shares = np.linspace(-0.5, 1.5, 41)
    near_poses, far_poses = interpolate_poses(first, second, shares), interpolate_poses(*far, shares)
    error = np.abs(far_poses[:, :3, 3] - np.array(shift_m) - near_poses[:, :3, 3]).max()
    back = np.abs((invert_pose(far[0]) @ far[0]) - np.eye(4)).max()
    return Reading(error=float(max(error, back)), limit=1e-8, unit="m")


def _bad_poses() -> Reading:
    poses = np.stack([np.eye(4)] * 3)
    poses[1, 0, 3] = np.nan
    return refused(DataError, lambda: Trajectory(np.arange(3.0), poses, np.zeros(3)))


_SHIFTED = [
    Case(function, f"poses shifted by {name}", partial(check, shift))
    for name, shift in (("3.8 km", KITTI_360_M), ("5e6 m along each axis", FAR_M))
    for function, check in (
        ("sensors.sweep.compensate", _rays),
        ("simulation.lidar_rays.sweep_rays", _simulated),
        ("evidence.static.surfels.build_surfels + candidates_of", _evidence),
        ("geometry.se3.interpolate_poses", _between),
    )
]
CASES = (
    *_SHIFTED,
    Case("sensors.sweep.Trajectory", "a pose is NaN (outside)", _bad_poses),
    Case(
        "sensors.sweep.Trajectory", "two poses at one time (outside)",
        lambda: refused(DataError, lambda: Trajectory(np.zeros(2), np.stack([np.eye(4)] * 2), np.zeros(3))),
    ),
    Case(
        "sensors.sweep.Trajectory.at", "NaN and a time far outside (outside)",
        lambda: refused(DataError, lambda: drive((0.0, 0.0, 0.0)).at(np.array([np.nan, 0.1]))),
    ),
)  # fmt: skip
