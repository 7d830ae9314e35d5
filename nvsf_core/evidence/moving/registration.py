"""How an object moved between two scans: point-to-plane registration of its returns."""

from dataclasses import dataclass

import numpy as np

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

    Args:
        clouds: All clouds.
        first: (p,) numbers of the clouds that moved.
        second: (p,) numbers of the clouds they are registered to.
        shift_m: (p, 3) first guess of the shifts; the first guess of every yaw is 0.
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
