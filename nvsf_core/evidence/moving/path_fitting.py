"""The path of one track: its clusters are registered in pairs, then smoothed and continued at both ends."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solveh_banded
from scipy.spatial import cKDTree

from nvsf_core.evidence.moving.object_evidence import MovingObject
from nvsf_core.evidence.moving.visibility import AboveGround, TimedReturns
from nvsf_core.geometry.voxels import PLANE_POINTS, planes_around
from nvsf_core.kernels.registration import register_pairs

_MOST_POINTS = 400
_PLANE_EIGENVALUE_RATIO = 4.0
_GATES_M = np.array([1.2, 0.8, 0.5, 0.35])
_YAW_RETURNS = 40
_YAW_SIZE_M = 0.7
_FLOOR = np.array([0.006, 0.015, 0.015, 0.015])
"""Least standard deviation of a registered yaw (radians) and shift (metres), however many points it has."""
_LEAST_INLIERS = 0.3
_STRIDES = (1, 2, 4)
_REACH_M = 0.5
_MOST_SHIFT_M = 0.5
_LEAST_SHARE = 0.25
_LEAST_CARRIED = 0.5
"""Share of inliers with which an object is found in a scan where it made no cluster."""
_MOST_RESIDUAL_M = 0.2
_MOST_MISSES = 2
_MODEL_SCANS = 3
LEAST_RETURNS = 8
"""Fewer in a scan tell nothing of where an object is."""


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """An object's returns in one scan, moved to one instant, with their planes."""

    centre_m: np.ndarray
    """(3,) float64 mean, scene-local metres."""
    point_m: np.ndarray
    """(k, 3) float32 metres from the centre, k <= 400."""
    normal: np.ndarray
    """(k, 3) float32 unit, 0 where the neighbourhood is no plane."""

    @property
    def tells_yaw(self) -> bool:
        """Whether it is large and dense enough for its yaw to be measured."""
        return len(self.point_m) >= _YAW_RETURNS and bool(np.ptp(self.point_m, axis=0).max() >= _YAW_SIZE_M)


@dataclass(frozen=True, slots=True, eq=False)
class PairMotions:
    """Measured motions of p pairs of clouds: a point c + u moves to R(yaw) u + c + shift."""

    first: np.ndarray
    """(p,) int64 number of the cloud that moved."""
    second: np.ndarray
    """(p,) int64 number of the cloud it was registered to."""
    centre_m: np.ndarray
    """(p, 3) float64 c, the first cloud's centre."""
    motion: np.ndarray
    """(p, 4) float64 yaw in radians, shift in metres."""
    information: np.ndarray
    """(p, 4, 4) float64 inverse covariance of `motion`."""
    inlier_share: np.ndarray
    """(p,) share of the first cloud's points with a partner."""
    residual_m: np.ndarray
    """(p,) mean distance of those points."""


def make_cloud(point_m: np.ndarray) -> Cloud:
    """A cloud of at least one point (k, 3), scene-local metres, thinned evenly to at most 400."""
    thinned = point_m[np.linspace(0, len(point_m) - 1, min(len(point_m), _MOST_POINTS)).astype(np.int64)]
    centre = thinned.mean(axis=0, dtype=np.float64)
    local = thinned - centre
    normal = np.zeros_like(local)
    if len(local) > PLANE_POINTS:
        values, across = planes_around(local)
        planar = values[:, 1] > _PLANE_EIGENVALUE_RATIO * values[:, 0]
        normal[planar] = across[planar]
    return Cloud(centre, local.astype(np.float32), normal.astype(np.float32))


def register(clouds: list[Cloud], first: np.ndarray, second: np.ndarray, shift_m: np.ndarray) -> PairMotions:
    """Register pairs of clouds; pairs in which fewer than 30 % of the points find a partner are left out.

    The clouds `first` (p,) moved onto the clouds `second` (p,), by numbers; `shift_m` (p, 3) is the first
    guess of the shifts, that of every yaw is 0.
    """
    centre = np.array([cloud.centre_m for cloud in clouds])
    between = centre[second] - centre[first]
    yaw_free = np.array(
        [clouds[a].tells_yaw and clouds[b].tells_yaw for a, b in zip(first, second, strict=True)], bool
    )
    start = np.concatenate([np.zeros((len(first), 1)), shift_m - between], axis=1)
    packed = (
        np.ascontiguousarray(np.concatenate([cloud.point_m for cloud in clouds]).T),
        np.ascontiguousarray(np.concatenate([cloud.normal for cloud in clouds]).T),
        np.concatenate([[0], np.cumsum([len(cloud.point_m) for cloud in clouds])]),
    )
    motion, information, quality = register_pairs(packed, first, second, start, yaw_free, _GATES_M)
    motion[:, 1:] += between
    kept = (quality[:, 0] >= _LEAST_INLIERS) & np.isfinite(motion).all(axis=1)
    motion[~yaw_free, 0] = 0.0
    covariance = _covariance(information[kept], quality[kept, 2], yaw_free[kept])
    return PairMotions(
        first=first[kept],
        second=second[kept],
        centre_m=centre[first[kept]],
        motion=motion[kept],
        information=np.linalg.inv(covariance),
        inlier_share=quality[kept, 0],
        residual_m=quality[kept, 1],
    )


def _covariance(information: np.ndarray, energy: np.ndarray, yaw_free: np.ndarray) -> np.ndarray:
    """Covariance (p, 4, 4): the residuals' variance times the inverse information, plus the floor."""
    known = information.copy()
    # A yaw that was not estimated has no correlations; all that is known is that it is small.
    known[~yaw_free, 0, :] = 0.0
    known[~yaw_free, :, 0] = 0.0
    known[~yaw_free, 0, 0] = np.inf
    weak = 1e-3 * np.eye(4)
    scaled = np.where(np.isfinite(known), known, 1.0) + weak
    covariance = energy[:, None, None] * np.linalg.inv(scaled)
    covariance[~yaw_free, 0, 0] = 0.05**2
    covariance += np.diag(_FLOOR**2)
    return covariance


@dataclass(slots=True, eq=False)
class Path:
    """A track's poses while they are estimated."""

    scan: list[int]
    members: list[np.ndarray]
    """Indices of its returns in each scan, among all returns."""
    time_s: np.ndarray
    """(k,) mean times of its returns."""
    pose: np.ndarray
    """(k, 4) x, y, z in scene-local metres and yaw in radians."""

    def as_object(self, frame_s: float) -> MovingObject:
        """The path as an object, without an extent yet."""
        return MovingObject(
            np.array(self.scan, np.int32), self.time_s, self.pose, frame_s, np.zeros(3), np.zeros(3)
        )

    def shape(self, returns: TimedReturns, scans: slice = slice(None)) -> np.ndarray:
        """Returns (k, 3) of its scans in the object's frame, metres."""
        members = np.concatenate(self.members[scans])
        moving = self.as_object(returns.frame_s)
        return moving.to_object(returns.point_m[members].astype(np.float64), returns.time_s[members])

    @property
    def fastest_m_s(self) -> float:
        """Greatest speed from scan to scan."""
        step_m = np.linalg.norm(np.diff(self.pose[:, :3], axis=0), axis=1)
        return float((step_m / np.diff(self.time_s)).max())

    def insert(self, at: int, scan: int, members: np.ndarray, time_s: float, pose: np.ndarray) -> None:
        """Add a scan before the one at place `at`.

        Args:
            at: From 0 to the number of scans.
            scan: Its number.
            members: (k,) int64 indices of its returns of the object.
            time_s: Their mean time.
            pose: (4,) at that time.
        """
        self.scan.insert(at, scan)
        self.members.insert(at, members)
        self.time_s = np.insert(self.time_s, at, time_s)
        self.pose = np.insert(self.pose, at, pose, axis=0)


def solve_path(path: Path, returns: TimedReturns) -> None:
    """Register the path's clouds with one another and estimate its poses anew, in place."""
    clouds = _clouds(path, returns)
    first, second = [], []
    for stride in _STRIDES:
        first.append(np.arange(len(clouds) - stride))
        second.append(np.arange(stride, len(clouds)))
    i, k = np.concatenate(first), np.concatenate(second)
    # In both directions: a partial view matches a fuller one well, but not the other way round.
    i, k = np.concatenate([i, k]), np.concatenate([k, i])
    pairs = register(clouds, i, k, path.pose[k, :3] - path.pose[i, :3])
    if len(pairs.first) == 0:
        # Nothing tells how its clouds fit each other: it stays where its clusters are.
        return
    time_frames = (path.time_s - path.time_s[0]) / min(returns.frame_s, LONGEST_FRAME_S)
    path.pose = smooth_poses(path.pose, time_frames, pairs)


def carry_on(path: Path, returns: TimedReturns, above_ground: AboveGround) -> bool:
    """Follow the object, at both ends, into scans where it made no cluster; True if a scan was added."""
    grown = _carry(path, returns, above_ground, forward=True)
    return _carry(path, returns, above_ground, forward=False) or grown


def _carry(path: Path, returns: TimedReturns, above_ground: AboveGround, *, forward: bool) -> bool:
    step, misses, grown = (1 if forward else -1), 0, False
    scan = (path.scan[-1] if forward else path.scan[0]) + step
    while 0 <= scan < returns.scan_count and misses < _MOST_MISSES:
        found = _find_in_scan(path, returns, above_ground, scan, forward=forward)
        if found is None:
            misses += 1
        else:
            path.insert(len(path.scan) if forward else 0, scan, *found)
            grown, misses = True, 0
        scan += step
    return grown


def _find_in_scan(
    path: Path, returns: TimedReturns, above_ground: AboveGround, scan: int, *, forward: bool
) -> tuple[np.ndarray, float, np.ndarray] | None:
    """Members, mean time and pose of the object in a scan beyond the path's end; None where it is not."""
    part = slice(-_MODEL_SCANS, None) if forward else slice(0, _MODEL_SCANS)
    moving, model_o = _as_step(path, part).as_object(returns.frame_s), path.shape(returns, part)
    margin = _REACH_M + np.abs(model_o).max(axis=0).max()
    time_s = float(returns.scan_time_s[scan])
    # The object is hit up to half a sweep before or after the scan's instant: look again at that time.
    for _ in range(2):
        pose = moving.pose_at(np.array([time_s]))[0]
        near = above_ground.loose_near(returns, scan, pose[:3] - margin, pose[:3] + margin)
        if len(near) < LEAST_RETURNS:
            return None
        time_s = float(returns.time_s[near].mean())
    local = moving.to_object(returns.point_m[near].astype(np.float64), returns.time_s[near])
    distance, _ = cKDTree(model_o).query(local, distance_upper_bound=_REACH_M)
    members = near[np.isfinite(distance)]
    last = len(path.members[-1 if forward else 0])
    if len(members) < max(_LEAST_SHARE * last, LEAST_RETURNS):
        return None
    time_s = float(returns.time_s[members].mean())
    pose = moving.pose_at(np.array([time_s]))[0]
    model_cloud = make_cloud(_to_scene(model_o, pose))
    cloud = make_cloud(_to_scene(local[np.isfinite(distance)], pose))
    pair = register([cloud, model_cloud], np.array([0]), np.array([1]), np.zeros((1, 3)))
    if len(pair.first) == 0 or pair.inlier_share[0] < _LEAST_CARRIED or pair.residual_m[0] > _MOST_RESIDUAL_M:
        return None
    if np.linalg.norm(pair.motion[0, 1:]) > _MOST_SHIFT_M:
        return None
    # The motion that brings the returns onto the prediction is the prediction's error.
    pose[:3] -= pair.motion[0, 1:]
    pose[3] -= pair.motion[0, 0]
    return members, time_s, pose


def _as_step(path: Path, part: slice) -> Path:
    """Some of the path's scans as one straight step, from which the velocity is predicted."""
    time_s, pose = path.time_s[part][[0, -1]], path.pose[part][[0, -1]]
    return Path([path.scan[part][0], path.scan[part][-1]], [], time_s, pose)


def _to_scene(point_o: np.ndarray, pose: np.ndarray) -> np.ndarray:
    cosine, sine = np.cos(pose[3]), np.sin(pose[3])
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return point_o @ turn.T + pose[:3]


def _clouds(path: Path, returns: TimedReturns) -> list[Cloud]:
    """Each scan's returns, moved to their mean time by the path's velocity there."""
    velocity = _velocity(path.time_s, path.pose[:, :3])
    clouds = []
    for members, time_s, v in zip(path.members, path.time_s, velocity, strict=True):
        late_s = returns.time_s[members] - time_s
        clouds.append(make_cloud(returns.point_m[members] - late_s[:, None] * v))
    return clouds


def _velocity(time_s: np.ndarray, position_m: np.ndarray) -> np.ndarray:
    """Velocity (k, 3) in m/s of the quadratic fitted to positions (k, 3)."""
    middle = time_s - time_s.mean()
    degree = min(2, len(time_s) - 1)
    matrix = np.stack([middle**power for power in range(degree + 1)], axis=1)
    coefficients = np.linalg.lstsq(matrix, position_m, rcond=None)[0]
    slope = sum(
        power * middle[:, None] ** (power - 1) * coefficients[power] for power in range(1, degree + 1)
    )
    return np.broadcast_to(np.asarray(slope, np.float64), position_m.shape)


LONGEST_FRAME_S = 0.12
"""What is known of motion a frame is of sensors of 10 Hz and more: things brake and turn no less because they
are seen less often."""
_STEPS = 8
_JERK = np.array([0.03, 0.03, 0.009, 0.01])
"""Standard deviation of the acceleration of x, y, z (metres per frame^2) and yaw (radians per frame^2)."""
_PIN = 1e8
"""Weight that keeps the middle pose where it is."""
_ROBUST = 9.0
"""Squared Mahalanobis distance at which a pair's weight is one half."""


def smooth_poses(pose: np.ndarray, time_frames: np.ndarray, pairs: PairMotions) -> np.ndarray:
    """Poses (k, 4) float64 of x, y, z (metres) and yaw (radians): the smooth path that best fits the pairs.

    Args:
        pose: (k, 4) first guess; the middle one is kept.
        time_frames: (k,) ascending times in frames.
        pairs: Motions between the k scans' clouds.
    """
    pose = pose.copy()
    count = len(pose)
    prior = _second_differences(time_frames)
    for _ in range(_STEPS):
        system = np.zeros((count, 4, count, 4))
        right = np.zeros((count, 4))
        _add_pairs(pose, pairs, system, right)
        for axis in range(4):
            weighted = prior / _JERK[axis] ** 2
            system[:, axis, :, axis] += prior.T @ weighted
            right[:, axis] -= weighted.T @ (prior @ pose[:, axis])
        system[count // 2, range(4), count // 2, range(4)] += _PIN
        step = _solve(system.reshape(4 * count, 4 * count), right.ravel()).reshape(count, 4)
        pose += step
        if np.abs(step).max() < 1e-6:
            break
    return pose


def _solve(system: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve a positive definite banded system: scans are tied to near ones only."""
    reach = int(np.ptp(np.nonzero(system), axis=0).max())
    bands = np.zeros((reach + 1, len(system)))
    for k in range(reach + 1):
        bands[k, : len(system) - k] = np.diagonal(system, -k)
    return np.asarray(solveh_banded(bands, right, lower=True))


def _second_differences(time: np.ndarray) -> np.ndarray:
    """Matrix (k - 2, k) that gives accelerations, each weighted by the root of the time it stands for."""
    rows = max(len(time) - 2, 0)
    matrix = np.zeros((rows, len(time)))
    before, after = time[1:-1] - time[:-2], time[2:] - time[1:-1]
    middle = 0.5 * (before + after)
    row = np.arange(rows)
    scale = 1.0 / np.sqrt(middle)
    matrix[row, row] = scale / before
    matrix[row, row + 1] = -scale * (1.0 / before + 1.0 / after)
    matrix[row, row + 2] = scale / after
    return matrix


def _add_pairs(pose: np.ndarray, pairs: PairMotions, system: np.ndarray, right: np.ndarray) -> None:
    """Add the pair motions' normal equations in place.

    A pair measures R(psi_j - psi_i) (c - x_i) + x_j = c + shift, and the yaw psi_j - psi_i.
    """
    i, k = pairs.first, pairs.second
    turn = pose[k, 3] - pose[i, 3]
    cosine, sine = np.cos(turn), np.sin(turn)
    arm = pairs.centre_m - pose[i, :3]
    moved = np.stack(
        [cosine * arm[:, 0] - sine * arm[:, 1], sine * arm[:, 0] + cosine * arm[:, 1], arm[:, 2]], axis=1
    )
    residual = np.empty((len(i), 4))
    residual[:, 1:] = moved + pose[k, :3] - pairs.centre_m - pairs.motion[:, 1:]
    residual[:, 0] = np.remainder(turn - pairs.motion[:, 0] + np.pi, 2 * np.pi) - np.pi

    # Columns x, y, z, yaw; rows yaw, x, y, z as the information has them.
    to_first, to_second = np.zeros((len(i), 4, 4)), np.zeros((len(i), 4, 4))
    to_first[:, 0, 3], to_second[:, 0, 3] = -1.0, 1.0
    to_first[:, 1, 0], to_first[:, 1, 1] = -cosine, sine
    to_first[:, 2, 0], to_first[:, 2, 1] = -sine, -cosine
    to_first[:, 3, 2] = -1.0
    to_second[:, 1:, :3] = np.eye(3)
    to_first[:, 1, 3], to_first[:, 2, 3] = moved[:, 1], -moved[:, 0]
    to_second[:, 1, 3], to_second[:, 2, 3] = -moved[:, 1], moved[:, 0]

    weight = 1.0 / (1.0 + np.einsum("pi,pij,pj->p", residual, pairs.information, residual) / _ROBUST)
    information = pairs.information * weight[:, None, None]
    for one, jacobian in ((i, to_first), (k, to_second)):
        weighted = np.einsum("pij,pik->pjk", jacobian, information)
        np.add.at(right, one, -np.einsum("pjk,pk->pj", weighted, residual))
        for other, partner in ((i, to_first), (k, to_second)):
            np.add.at(system.transpose(0, 2, 1, 3), (one, other), weighted @ partner)
