"""Poses of consecutive scans, refined together: surfaces that several of them saw are to be one.

The points of each scan are laid on the planes of scans some frames before and after it, and all poses of a
window are solved for at once (Gauss-Newton, distances point to plane, far ones weighted down). Odometry lays
a scan on what came before it only, so its errors add up; here they are spread over the window.

A spinning LiDAR's elevations are off by a common angle (an HDL-64E's by 0.14 to 0.2 degrees), which lifts
the ground more the farther off it is: the path climbs and pitches. That angle is solved for as well.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from nvsf_core.clouds.registration import LEAST_ACROSS
from nvsf_core.geometry.se3 import exp_se3, exp_so3, invert_pose, log_se3, log_so3, transform_points

_WINDOW, _KEPT = 32, 8
"""Scans that are solved for at once; so many of the window before are laid on and stay."""
_REACH = (1, 2, 4, 8)
"""Frames between two scans that are laid on each other."""
FARTHEST_REACH = _REACH[-1]
_NEAR_M, _FAR_M = 3.0, 40.0
_THIN_M = 0.3
_MOST_POINTS, _MOST_LAID = 12_000, 1500
"""Of a scan: points whose planes others are laid on, and points that are laid on theirs."""
_NEIGHBOURS = 12
_WIDEST_M, _THICKEST_M, _FLATTEST = 1.0, 0.05, 4.0
"""A plane's neighbours reach no farther; its rms thickness; how much more it spreads within than across."""
_GATES_M = (0.5, 0.35, 0.25, 0.17, 0.12, 0.1, 0.1, 0.1, 0.1, 0.1)
"""Distance from a plane beyond which a point counts for nothing, by round."""
_LAST_GATES_M = _GATES_M[-5:]
_FEWEST_PAIRS = 50
_STEP_M, _STEP_RAD, _ANGLE_RAD = 0.1, 0.01, 0.004
"""How far the odometry's steps and the elevations are believed to be off, where no surface says it."""
_HELD_M = 1e-3
"""The same along a direction that no surface holds."""
_NOISE_M = 0.02
_PAIRS_ARE_ONE = 20.0
"""So many pairs of a surface tell as much as one would whose errors were independent."""


@dataclass(frozen=True, slots=True, eq=False)
class RefinedPath:
    """A refined path, and how well it fits."""

    poses: np.ndarray
    """(n, 4, 4), sensor to world; the first is as given."""
    elevation_rad: float
    """By how much the rays have to be turned up for the scans to agree."""
    before_m: float
    """Median distance of points from planes of other scans, by the given path."""
    after_m: float
    """The same by the refined path."""


class _Cloud(NamedTuple):
    """A thinned scan, in the sensor's frame at the scan's middle."""

    raw_m: np.ndarray
    """(n, 3) as recorded, in the moving sensor's frame."""
    fraction: np.ndarray
    """(n,) their times, in sweeps."""
    point_m: np.ndarray
    lifted_m: np.ndarray
    """Motion (n, 3) of each point for a radian by which its ray is turned up."""
    normal: np.ndarray
    """(n, 3); zero where there is no plane."""
    middle_m: np.ndarray
    """(n, 3) of the plane."""
    tree: cKDTree
    laid: np.ndarray
    """Indices of the points that are laid on other scans."""


class _Pairs(NamedTuple):
    """Points of scan `a` on planes of scan `b`, in the world."""

    a: int
    b: int
    point_m: np.ndarray
    normal: np.ndarray
    distance_m: np.ndarray
    lift_m: np.ndarray
    """Change of the distance for a radian by which all rays are turned up."""


def refine_path(scans: Iterable[tuple[np.ndarray, np.ndarray]], poses: np.ndarray) -> RefinedPath:
    """Refine the poses (n, 4, 4), sensor to world, metres, of consecutive scans.

    Args:
        scans: Of each its points (m, 3) in the sensor's frame at firing time, metres, and their times (m,),
            in sweeps, -0.5 to 0.5. They are read once, and a window of them is kept.
        poses: Close enough for surfaces to lie within half a metre of themselves.
    """
    found = np.array(poses, np.float64)
    elevation_rad = 0.0
    clouds: list[_Cloud] = []
    kept = 1
    before: list[np.ndarray] = []
    after: list[np.ndarray] = []
    for number, (points_m, fraction) in enumerate(scans):
        raw_m, times = _thinned(points_m, fraction)
        clouds.append(_cloud(raw_m, times, _step(found, number)))
        if len(clouds) < _WINDOW and number < len(found) - 1:
            continue
        part = slice(number + 1 - len(clouds), number + 1)
        given = found[part].copy()
        before.append(_distances_m(clouds, given, 0.0))
        found[part], elevation_rad = _solved(clouds, given, kept, elevation_rad, _GATES_M)
        # By the better path the points of a sweep lie better among themselves.
        clouds = [_cloud(one.raw_m, one.fraction, _step(found[part], k)) for k, one in enumerate(clouds)]
        found[part], elevation_rad = _solved(clouds, found[part], kept, elevation_rad, _LAST_GATES_M)
        after.append(_distances_m(clouds, found[part], elevation_rad))
        found[number + 1 :] = found[number] @ invert_pose(given[-1:])[0] @ found[number + 1 :]
        clouds, kept = clouds[-_KEPT:], _KEPT
    before_m, after_m = _median(before), _median(after)
    # Where it fits no better, as with next to nothing to lay on each other, the given path stands.
    if not after_m < before_m:
        return RefinedPath(np.array(poses, np.float64), 0.0, before_m, before_m)
    return RefinedPath(found, elevation_rad, before_m, after_m)


def _step(poses: np.ndarray, number: int) -> np.ndarray:
    """(6,) motion in a sweep around one of the scans."""
    first, last = max(0, number - 1), min(len(poses) - 1, number + 1)
    step: np.ndarray = log_se3(invert_pose(poses[first : first + 1]) @ poses[last : last + 1])[0]
    return step / max(1, last - first)


def _thinned(points_m: np.ndarray, fraction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points and times of a scan in the range that is used, one a voxel: else near surfaces would decide."""
    range_m = np.linalg.norm(points_m, axis=1)
    near = np.flatnonzero((range_m > _NEAR_M) & (range_m < _FAR_M))
    if len(near):
        cell = np.floor(points_m[near] / _THIN_M).astype(np.int64)
        cell -= cell.min(axis=0)
        size = cell.max(axis=0) + 1
        number = (cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2]
        near = near[np.sort(np.unique(number, return_index=True)[1])]
        near = near[_evenly(len(near), _MOST_POINTS)]
    return points_m[near].astype(np.float64), fraction[near].astype(np.float64)


def _evenly(count: int, most: int) -> np.ndarray:
    return np.linspace(0, count - 1, min(count, most)).astype(np.int64)


def _cloud(raw_m: np.ndarray, fraction: np.ndarray, step: np.ndarray) -> _Cloud:
    across_m = np.maximum(np.hypot(raw_m[:, 0], raw_m[:, 1]), 1e-6)
    sunk = -raw_m[:, 2] / across_m
    lifted_m = np.stack([sunk * raw_m[:, 0], sunk * raw_m[:, 1], across_m], axis=1)
    moved = exp_se3(fraction[:, None] * step)
    point_m = np.einsum("nij,nj->ni", moved[:, :3, :3], raw_m) + moved[:, :3, 3]
    tree = cKDTree(point_m)
    normal, middle_m = _planes(point_m, tree)
    return _Cloud(raw_m, fraction, point_m, lifted_m, normal, middle_m, tree, _laid_points(normal))


def _laid_points(normal: np.ndarray) -> np.ndarray:
    """Points evenly, and more of those on upright planes, as many along each axis.

    A street has few surfaces across it, and these alone tell how far along it the sensor is (normal-space
    sampling: Rusinkiewicz and Levoy, 2001). Far ground has no planes of its own, but tells of the elevations.
    """
    facing = np.where(normal.any(axis=1), np.abs(normal).argmax(axis=1), -1)
    groups = [_evenly(len(normal), _MOST_LAID)]
    for axis in (0, 1):
        own = np.flatnonzero(facing == axis)
        groups.append(own[_evenly(len(own), _MOST_LAID // 2)])
    return np.unique(np.concatenate(groups))


def _planes(point_m: np.ndarray, tree: cKDTree) -> tuple[np.ndarray, np.ndarray]:
    """Normal and middle (n, 3) of the plane around each point; normals are 0 where there is none."""
    if len(point_m) < _NEIGHBOURS:
        return np.zeros_like(point_m), point_m
    away_m, near = tree.query(point_m, k=_NEIGHBOURS)
    middle_m = point_m[near].mean(axis=1)
    arms = point_m[near] - middle_m[:, None]
    squared_m2, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", arms, arms) / _NEIGHBOURS)
    flat = (away_m[:, -1] < _WIDEST_M) & (squared_m2[:, 0] < _THICKEST_M**2)
    flat &= squared_m2[:, 1] > _FLATTEST * squared_m2[:, 0]
    return np.where(flat[:, None], axes[:, :, 0], 0.0), middle_m


def _solved(
    clouds: list[_Cloud], given: np.ndarray, kept: int, elevation_rad: float, gates_m: tuple[float, ...]
) -> tuple[np.ndarray, float]:
    """Poses of a window, of which the first `kept` stay, and the elevations' error."""
    poses, n = given.copy(), len(clouds)
    free = np.arange(6 * kept, 6 * n + 1)
    if len(free) == 1:
        return poses, elevation_rad
    for gate_m in gates_m:
        all_pairs = list(_laid(clouds, poses, elevation_rad, gate_m))
        matrix, right = _priors(poses, given, elevation_rad, _free_shifts(all_pairs, n))
        for pairs in all_pairs:
            _add(matrix, right, pairs, poses, gate_m)
        motion = np.zeros(6 * n + 1)
        motion[free] = np.linalg.solve(matrix[np.ix_(free, free)], -right[free])
        turn, shift_m = np.split(motion[:-1].reshape(n, 6), 2, axis=1)
        poses[:, :3, :3] = exp_so3(turn) @ poses[:, :3, :3]
        poses[:, :3, 3] += shift_m
        elevation_rad += float(motion[-1])
    return poses, elevation_rad


def _free_shifts(all_pairs: list[_Pairs], count: int) -> np.ndarray:
    """Projections (count, 3, 3) onto the directions in which no surface holds a scan, as in a tunnel.

    What still seems to hold it there are errors of the normals: see `registration.slippage`.
    """
    squares, number = np.zeros((count, 3, 3)), np.zeros(count)
    for pairs in all_pairs:
        for scan in (pairs.a, pairs.b):
            squares[scan] += pairs.normal.T @ pairs.normal
            number[scan] += len(pairs.normal)
    share, axes = np.linalg.eigh(squares / np.maximum(number, 1.0)[:, None, None])
    free: np.ndarray = (axes * (share < LEAST_ACROSS)[:, None, :]) @ np.swapaxes(axes, 1, 2)
    return free


def _priors(
    poses: np.ndarray, given: np.ndarray, elevation_rad: float, free: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations of what is believed beforehand: the given path's steps, and exact elevations.

    A pose's six unknowns are its turn about the sensor and its shift, both in the world's axes. Along free
    directions (n, 3, 3) the step is kept.
    """
    n = len(poses)
    matrix, right = np.zeros((6 * n + 1, 6 * n + 1)), np.zeros(6 * n + 1)
    turn = log_so3(poses[:, :3, :3] @ np.swapaxes(given[:, :3, :3], 1, 2))
    moved = np.concatenate([turn, poses[:, :3, 3] - given[:, :3, 3]], axis=1)
    for k in range(1, n):
        weight = np.diag(np.repeat([_STEP_RAD**-2, _STEP_M**-2], 3))
        weight[3:, 3:] += free[k] / _HELD_M**2
        later, sooner = slice(6 * k, 6 * k + 6), slice(6 * k - 6, 6 * k)
        for one, sign in ((later, 1.0), (sooner, -1.0)):
            matrix[one, one] += weight
            right[one] += sign * weight @ (moved[k] - moved[k - 1])
        matrix[later, sooner] -= weight
        matrix[sooner, later] -= weight
    matrix[-1, -1] = _ANGLE_RAD**-2
    right[-1] = elevation_rad * _ANGLE_RAD**-2
    return matrix, right


def _laid(clouds: list[_Cloud], poses: np.ndarray, elevation_rad: float, gate_m: float) -> Iterator[_Pairs]:
    """All pairs of the scans of a window whose distance is within the gate."""
    for a, cloud in enumerate(clouds):
        point_m = cloud.point_m[cloud.laid] + elevation_rad * cloud.lifted_m[cloud.laid]
        placed_m = transform_points(poses[a], point_m)
        up_m = cloud.lifted_m[cloud.laid] @ poses[a, :3, :3].T
        for b in (a + sign * reach for reach in _REACH for sign in (-1, 1)):
            if not 0 <= b < len(clouds):
                continue
            other = clouds[b]
            there_m = transform_points(invert_pose(poses[b]), placed_m)
            away_m, near = other.tree.query(there_m, distance_upper_bound=_WIDEST_M)
            found = np.flatnonzero(np.isfinite(away_m))
            near = near[found]
            middle_m = other.middle_m[near] + elevation_rad * other.lifted_m[near]
            distance_m = ((there_m[found] - middle_m) * other.normal[near]).sum(axis=1)
            inside = (np.abs(distance_m) < gate_m) & other.normal[near].any(axis=1)
            found, near = found[inside], near[inside]
            if len(found) < _FEWEST_PAIRS:
                continue
            turn = poses[b, :3, :3].T
            normal = other.normal[near] @ turn
            lift_m = ((up_m[found] - other.lifted_m[near] @ turn) * normal).sum(axis=1)
            yield _Pairs(a, b, placed_m[found], normal, distance_m[inside], lift_m)


def _add(matrix: np.ndarray, right: np.ndarray, pairs: _Pairs, poses: np.ndarray, gate_m: float) -> None:
    """Add the pairs of two scans to the normal equations."""
    # Geman and McClure's weight: what moved, and what only looks alike, hardly counts.
    weight = (1.0 + (pairs.distance_m / (0.3 * gate_m)) ** 2) ** -2 / (_NOISE_M**2 * _PAIRS_ARE_ONE)
    parts = []
    for scan, sign in ((pairs.a, 1.0), (pairs.b, -1.0)):
        turn = np.cross(pairs.point_m - poses[scan, :3, 3], pairs.normal)
        parts.append((slice(6 * scan, 6 * scan + 6), sign * np.concatenate([turn, pairs.normal], axis=1)))
    parts.append((slice(len(right) - 1, len(right)), pairs.lift_m[:, None]))
    for rows, one in parts:
        right[rows] += one.T @ (weight * pairs.distance_m)
        for columns, other in parts:
            matrix[rows, columns] += one.T @ (weight[:, None] * other)


def _distances_m(clouds: list[_Cloud], poses: np.ndarray, elevation_rad: float) -> np.ndarray:
    found = _laid(clouds, poses, elevation_rad, _GATES_M[0])
    return np.abs(np.concatenate([np.zeros(0), *(pairs.distance_m for pairs in found)]))


def _median(parts: list[np.ndarray]) -> float:
    values = np.concatenate([np.zeros(0), *parts])
    return float(np.median(values)) if len(values) else float("nan")
