"""Checks of scans against poses: registration of neighbours, scans at their neighbours' poses, and z."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from nvsf_core.clouds.ground_normal import ground_normals, surface_normals
from nvsf_core.clouds.registration import Registration, register
from nvsf_core.errors import MissingLibraryError
from nvsf_core.stages.checks.declared import (
    FEWEST_MATCHED,
    FRAME_CHECK,
    MOST_OF_MEDIAN,
    MOST_TILT_DEG,
    MOST_TURN_DEG,
    ORDER_CHECK,
    UPRIGHT_CHECK,
)
from nvsf_core.stages.runner.stage import Check

MOST_SHIFT_M = 0.15
"""Largest shift of a pair. Registration was off by 0.024 m at most over 91 pairs of three streets."""
MOST_MISFIT = 1.15
"""Measured: at most 0.8 over real streets, 1.1 with 8 lasers and 64 firings; from 1.3 for swapped scans."""
_MOST_REGISTERED = 10_000
"""Points of a pair's later scan that are registered: more of a dense one take five times as long, and move by
less than 1 mm more or less."""
_NAMED = 5
_THIN_M = 0.5
_NEAR_M, _FAR_M = 3.0, 40.0
_FEWEST_POINTS, _MOST_POINTS = 500, 40_000
_MOST_TRIED = 1200
_FEWEST_SCANS = 3
_LEAST_M = 1e-3
_LEAST_MEDIAN_M = 0.05
"""Where the sensor stands, the median scan lies closer: others are farther off only because cars pass."""
_NEIGHBOURS = 2
"""Number of scans before and after that a scan is compared with, and whose poses are tried."""
_FARTHEST_M = 1.0
"""Largest distance that counts: a surface that only one scan saw must not decide."""
_LEAST_ACROSS = 0.02
"""Least share of a way across the surfaces around for which scans can tell that it is wrong.

Rings of returns travel with the sensor: where nothing else changes along the way, they fit best without it.
0.008 along a tunnel, 0.034 in a field of posts, from 0.057 in streets."""

_LEAST_BELOW = 0.1
"""Least share of the level surfaces that must lie below the LiDAR; else the ground lies on its upper side.

0.97 in streets and a tunnel, 0.81 with four lasers; up to 0.03 where scans' z points down. Under the ceiling
of a car park about half."""
_Z_DOWN = (
    "the ground lies above the LiDAR, so the scans' z points down: write scans as x forward, y left, z up "
    "(z negated; y, too, where it points right), and poses in a world with z up"
)
_HANGS = (
    "the LiDAR hangs upside down: write scans as x forward, y left, z up, quaternions as x, y, z, w, and "
    "poses in a world with z up"
)
_UPSIDE_DOWN = (
    "the sensor stands upside down in the world; write quaternions as x, y, z, w and poses in a world with "
    "z up (not down, as north-east-down)"
)
_MUCH_BETTER = 0.75
"""Measured on streets of all headings: 0.47 to 0.61 for the right reading of quaternions in another order;
the best wrong reading of right poses 1.3 or more."""
_BETTER = 0.96
"""The same for scans along other axes, which only bends tell: 0.74 to 0.95 for the right ones; for others
0.99 or more, also with poses 0.3 m off."""


def agreement_check(arrays: Mapping[str, np.ndarray], lidar_to_scene: np.ndarray) -> Check:
    """As `registration_check`, and where scans disagree, how poses would have to be read for them to agree.

    Args:
        arrays: Arrays of `sweeps/returns.zarr`.
        lidar_to_scene: (n, 4, 4) float64 poses of its scans, scene-local, metres.
    """
    agree = registration_check(arrays)
    if not agree.passed and (words := _read_otherwise(arrays, lidar_to_scene)):
        agree = replace(agree, detail=f"scans fit their poses {words}; {agree.detail}")
    return agree


def _read_otherwise(arrays: Mapping[str, np.ndarray], lidar_to_scene: np.ndarray) -> str:
    """See `other_reading`, of scans placed by their poses (n, 4, 4) in the scene."""
    clouds = [_evenly(thinned_scan(arrays, k), _MOST_TRIED) for k in range(len(arrays["frame"]))]
    from_scene = np.linalg.inv(lidar_to_scene)
    points_m = [one @ pose[:3, :3].T + pose[:3, 3] for one, pose in zip(clouds, from_scene, strict=True)]
    return other_reading(points_m, arrays["lidar_to_world"])


def _evenly(cloud_m: np.ndarray, most: int) -> np.ndarray:
    """At most so many of a cloud's points (N, 3)."""
    return cloud_m[np.linspace(0, len(cloud_m) - 1, min(len(cloud_m), most)).astype(np.int64)]


def order_check(arrays: Mapping[str, np.ndarray], lidar_to_scene: np.ndarray) -> Check:
    """Check that each scan fits its own pose best; works with few returns, and without open3d.

    Args:
        arrays: Arrays of `sweeps/returns.zarr`.
        lidar_to_scene: (n, 4, 4) float64 poses of its scans, scene-local, metres.
    """
    evenly = [_evenly(thinned_scan(arrays, k), _MOST_TRIED) for k in range(len(arrays["frame"]))]
    own_m, other_m, across = scan_misfits(evenly, lidar_to_scene)
    known, is_free = np.isfinite(own_m), across < _LEAST_ACROSS
    if np.count_nonzero(known) < _FEWEST_SCANS:
        return ORDER_CHECK.not_run(
            f"fewer than {_FEWEST_SCANS} scans with returns from {_NEAR_M:g} to {_FAR_M:g} m"
        )
    misfit = np.where(known & ~is_free, own_m / np.maximum(other_m, _LEAST_M), 0.0)
    of_median = np.where(known, own_m, 0.0) / max(float(np.median(own_m[known])), _LEAST_MEDIAN_M)
    wrong = np.flatnonzero((misfit > MOST_MISFIT) | (of_median > MOST_OF_MEDIAN))
    free = f"of {np.count_nonzero(is_free)} scans nothing can be said: no surface there fixes the way driven"
    if len(wrong) == 0 and is_free[known].all():
        return ORDER_CHECK.not_run(free)
    named = _first([str(arrays["frame"][k]) for k in wrong.tolist()])
    is_all = len(wrong) == np.count_nonzero(known)
    cause = "are all poses or their times wrong" if is_all else "were files swapped or copied"
    return Check(
        name=ORDER_CHECK.name,
        passed=len(wrong) == 0,
        detail=f"{len(wrong)} of {len(own_m)} scans lie better at another frame's pose, or at none"
        + (f": frames {named}; {cause}?" if len(wrong) else "")
        + (f"; {free}" if is_free.any() else ""),
        value=float(misfit.max()),
        limit=MOST_MISFIT,
    )


def upright_check(
    arrays: Mapping[str, np.ndarray], lidar_to_scene: np.ndarray, scene_to_world: np.ndarray
) -> Check:
    """Check that z is up: the ground lies level in the mean, or as the LiDAR stands, as on a hill.

    Args:
        arrays: Arrays of `sweeps/returns.zarr`.
        lidar_to_scene: (n, 4, 4) float64 poses of its scans, scene-local, metres.
        scene_to_world: (4, 4) pose of the scene's frame in the drive's own world; z is that world's.
    """
    clouds = [thinned_scan(arrays, k) for k in range(len(arrays["frame"]))]
    normals, scans, below = ground_normals(clouds, lidar_to_scene)
    if len(scans) < _FEWEST_SCANS:
        return UPRIGHT_CHECK.not_run(f"ground is seen around {len(scans)} scans, expected {_FEWEST_SCANS}")
    if below.mean() < _LEAST_BELOW:
        normals = -normals
    normal = normals.mean(axis=0) / np.linalg.norm(normals.mean(axis=0))
    from_lidar = np.mean((normals * lidar_to_scene[scans, :3, 2]).sum(axis=1))
    off_z_deg, off_lidar_deg = np.degrees(np.arccos(np.clip([normal[2], from_lidar], -1.0, 1.0)))
    is_upside_down = max(off_z_deg, off_lidar_deg) > 90.0
    off_deg = float((max if is_upside_down else min)(off_z_deg, off_lidar_deg))
    is_tilted = off_deg > MOST_TILT_DEG
    if off_lidar_deg > 90.0:
        remedy = _Z_DOWN if off_z_deg > 90.0 else _HANGS
    elif is_upside_down:
        remedy = _UPSIDE_DOWN
    else:
        remedy = (
            "what does not move may be taken to move; turn all poses (from the left) so that the normal, "
            f"{_vector(scene_to_world[:3, :3] @ normal)}, becomes (0, 0, 1)"
        )
    return Check(
        name=UPRIGHT_CHECK.name,
        passed=not is_tilted,
        detail=f"the ground's normal is {off_z_deg:.1f} degrees off the poses' z and {off_lidar_deg:.1f} off "
        f"the LiDAR's, in the mean of {len(scans)} scans{': ' + remedy if is_tilted else ''}",
        value=off_deg,
        limit=MOST_TILT_DEG,
        unit="deg",
    )


def registration_check(arrays: Mapping[str, np.ndarray]) -> Check:
    """Register each scan to the one before by point-to-plane ICP, starting from their poses.

    Returns:
        A check that warns and never blocks, and names the frames that disagree. Without open3d its detail is
        "not run" and the package to install.
    """
    frame = arrays["frame"]
    clouds = [thinned_scan(arrays, k) for k in range(len(frame))]
    # Every pair: where poses jump between two scans, all others agree.
    first = [k for k in range(len(frame) - 1) if min(len(clouds[k]), len(clouds[k + 1])) >= _FEWEST_POINTS]
    if not first:
        return FRAME_CHECK.not_run("no two neighbouring scans with enough returns")
    try:
        found = [register(_evenly(clouds[k + 1], _MOST_REGISTERED), clouds[k]) for k in first]
    except MissingLibraryError as error:
        return Check(name=FRAME_CHECK.name, passed=True, detail=str(error))
    shift_m = np.array([one.shift_m for one in found])
    turn_deg = np.array([one.turn_deg for one in found])
    matched = np.array([one.matched for one in found])
    pair = [f"{frame[k]} and {frame[k + 1]}" for k in first]
    wrong = np.flatnonzero((shift_m > MOST_SHIFT_M) | (turn_deg > MOST_TURN_DEG) | (matched < FEWEST_MATCHED))
    worst = int(wrong[shift_m[wrong].argmax()]) if len(wrong) else int(shift_m.argmax())
    return Check(
        name=FRAME_CHECK.name,
        passed=len(wrong) == 0,
        detail=f"{len(pair)} pairs, the worst (frames {pair[worst]}) moved by {shift_m[worst]:.3f} m and "
        f"{turn_deg[worst]:.2f} degrees, {matched[worst]:.0%} of points matched; {_in_words(wrong, pair)}"
        f"{_unconstrained(found, pair)}",
        value=float(shift_m[worst]),
        limit=MOST_SHIFT_M,
        unit="m",
    )


def _in_words(wrong: np.ndarray, pair: list[str]) -> str:
    if len(wrong) == 0:
        return f"expected at most {MOST_SHIFT_M} m and {MOST_TURN_DEG} degrees"
    return f"poses or times are doubtful at frames {_first([pair[k] for k in wrong.tolist()])}"


def _first(names: list[str]) -> str:
    more = "" if len(names) <= _NAMED else f" and {len(names) - _NAMED} more"
    return ", ".join(names[:_NAMED]) + more


def _unconstrained(found: list[Registration], pair: list[str]) -> str:
    """The motions that the scans do not constrain, for the pair with the most of them; empty if none."""
    free = [len(one.free_shifts) + len(one.free_turns) for one in found]
    most = int(np.argmax(free))
    if free[most] == 0:
        return ""
    directions = [f"along {_vector(axis)}" for axis in found[most].free_shifts]
    directions += [f"turning about {_vector(axis)}" for axis in found[most].free_turns]
    return (
        f"; in {np.count_nonzero(free)} of {len(pair)} pairs the scans do not fix every motion: of frames "
        f"{pair[most]} nothing can be said {', '.join(directions)} (scene axes)"
    )


def _vector(axis: np.ndarray) -> str:
    return "(" + ", ".join(f"{value + 0.0:.2f}" for value in np.round(axis, 2)) + ")"


def thinned_scan(arrays: Mapping[str, np.ndarray], scan: int) -> np.ndarray:
    """(m, 3) points of a scan, scene-local, metres; one per voxel, else near surfaces would dominate."""
    part = slice(int(arrays["offsets"][scan]), int(arrays["offsets"][scan + 1]))
    range_m = arrays["range_m"][part]
    used = ~arrays["is_own_vehicle"][part] & (range_m > _NEAR_M) & (range_m < _FAR_M)
    points = arrays["origin_m"][part][used] + arrays["direction"][part][used] * range_m[used, None]
    if len(points) == 0:
        return points
    cell = np.floor(points / _THIN_M).astype(np.int64)
    cell -= cell.min(axis=0)
    # One number per cell: sorting rows of three takes ten times as long.
    size = cell.max(axis=0) + 1
    _, kept = np.unique((cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2], return_index=True)
    # Real scans leave a third of that; more points of a dense one would only cost minutes.
    evenly = np.linspace(0, len(kept) - 1, min(len(kept), _MOST_POINTS)).astype(np.int64)
    found: np.ndarray = points[np.sort(kept)[evenly]]
    return found


def scan_misfits(
    points_m: Sequence[np.ndarray], lidar_to_scene: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean distance of each scan's points from its neighbours', at its own pose and at the best of theirs.

    The second is the smaller one for a scan that belongs to another frame. Both are equal where the sensor
    does not move.

    Args:
        points_m: For each of n scans (N, 3) scene-local metres, placed by its own pose; few, evenly spread.
        lidar_to_scene: (n, 4, 4) poses of the scans.

    Returns:
        Two (n,) float64 in metres, at most 1; NaN where the scan or all its neighbours have no points. Third,
        (n,), the share of the motion to that other pose that goes across the surfaces around; 1 where the own
        pose fits about as well.
    """
    n = len(points_m)
    own_m, best_other_m, across = np.full(n, np.nan), np.full(n, np.nan), np.ones(n)
    for k, points in enumerate(points_m):
        near = [j for j in range(max(0, k - _NEIGHBOURS), min(n, k + _NEIGHBOURS + 1)) if j != k]
        around = np.concatenate([np.zeros((0, 3)), *(points_m[j] for j in near)])
        if len(points) == 0 or len(around) == 0:
            continue
        tree = cKDTree(around)
        from_pose = np.linalg.inv(lidar_to_scene[k])
        own_m[k] = _distance_m(tree, points, np.eye(4))
        others_m = [_distance_m(tree, points, lidar_to_scene[j] @ from_pose) for j in near]
        best_other_m[k] = min(others_m)
        if own_m[k] > MOST_MISFIT * best_other_m[k]:
            best = near[int(np.argmin(others_m))]
            across[k] = _across(around, lidar_to_scene[best] @ from_pose)
    return own_m, best_other_m, across


def _across(points_m: np.ndarray, motion: np.ndarray) -> float:
    """Mean squared share of a motion (4, 4) across the surfaces that points (N, 3) lie on; 1 where unknown.

    Of each point's own way: along a tunnel that bends the sensor turns, and slides along the walls.
    """
    placed_m, normals, _ = surface_normals(points_m)
    ways_m = placed_m @ (motion[:3, :3] - np.eye(3)).T + motion[:3, 3]
    squared_m2 = float(np.square(ways_m).sum())
    if squared_m2 < len(ways_m) * _LEAST_M**2 or len(normals) == 0:
        return 1.0
    return float(np.square((normals * ways_m).sum(axis=1)).sum()) / squared_m2


def _distance_m(tree: cKDTree, points_m: np.ndarray, motion: np.ndarray) -> float:
    """Mean distance of points (N, 3), moved by (4, 4), from the nearest in the tree."""
    moved_m = points_m @ motion[:3, :3].T + motion[:3, 3]
    distance_m, _ = tree.query(moved_m, distance_upper_bound=_FARTHEST_M)
    return float(np.minimum(distance_m, _FARTHEST_M).mean())


def other_reading(points_m: Sequence[np.ndarray], lidar_to_world: np.ndarray) -> str:
    """How poses, or scans' axes, would have to be read for scans to agree; empty where no reading is better.

    Poses of another frame than the LiDAR's, composed with its mounting, are not tried.

    Args:
        points_m: For each of n scans (N, 3), LiDAR frame, metres.
        lidar_to_world: (n, 4, 4) float64 poses as they were read.
    """

    def apart_m(poses: np.ndarray) -> float:
        poses = poses.copy()
        poses[:, :3, 3] -= poses[0, :3, 3].copy()  # beside millions of metres, centimetres would be lost
        placed = [one @ pose[:3, :3].T + pose[:3, 3] for one, pose in zip(points_m, poses, strict=True)]
        return float(np.nanmean(scan_misfits(placed, poses)[0]))

    own_m = apart_m(lidar_to_world)
    found_m = {words: apart_m(read(lidar_to_world)) / _MUCH_BETTER for words, read in _READINGS.items()}
    found_m |= {words: apart_m(lidar_to_world * axes) / _BETTER for words, axes in _SCANS_AXES.items()}
    best = min(found_m, key=lambda words: found_m[words])
    return best if found_m[best] < own_m else ""


def _of_order(order: Sequence[int]) -> Callable[[np.ndarray], np.ndarray]:
    """Read the numbers of each quaternion in another order than x, y, z, w."""

    def read(poses: np.ndarray) -> np.ndarray:
        found = poses.copy()
        numbers = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
        found[:, :3, :3] = Rotation.from_quat(numbers[:, order]).as_matrix()
        return found

    return read


_READINGS: Mapping[str, Callable[[np.ndarray], np.ndarray]] = {
    "if their quaternions are taken as w, x, y, z: write x, y, z, w": _of_order((1, 2, 3, 0)),
    "if their quaternions are taken as y, z, w, x: write x, y, z, w": _of_order((3, 0, 1, 2)),
    "if they are inverted: write poses of the LiDAR in the world": np.linalg.inv,
}
_SCANS_AXES: Mapping[str, np.ndarray] = {
    "if the scans' y points right: write scans as x forward, y left, z up": np.array([1.0, -1.0, 1.0, 1.0]),
    "if the scans' y points right, their z down: write scans as x forward, y left, z up": (
        np.array([1.0, -1.0, -1.0, 1.0])
    ),
}
