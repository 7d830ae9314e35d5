"""One smooth path of poses through all the motions that were measured between pairs of scans.

Poses (x, y, z, yaw) are found by Gauss-Newton from the pair motions, each with its information and a
robust weight, and from second differences: what has mass does not jump. Where an object's own frame sits
inside it nothing decides, so one pose in the middle is pinned.
"""

import numpy as np
from scipy.linalg import solveh_banded

from nvsf_core.evidence.moving.registration import PairMotions

_STEPS = 8
_JERK = np.array([0.03, 0.03, 0.009, 0.01])
"""A frame^2: deviation of the second difference of x, y, z in metres and of yaw in radians."""
_PIN = 1e8
_ROBUST = 9.0


def smooth_poses(pose: np.ndarray, time_frames: np.ndarray, pairs: PairMotions) -> np.ndarray:
    """Poses (k, 4) float64 of x, y, z, yaw that fit the pair motions best.

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
    """Solution of a positive definite system whose far entries are 0: scans are tied to near ones only."""
    reach = int(np.ptp(np.nonzero(system), axis=0).max())
    bands = np.zeros((reach + 1, len(system)))
    for k in range(reach + 1):
        bands[k, : len(system) - k] = np.diagonal(system, -k)
    return np.asarray(solveh_banded(bands, right, lower=True))


def _second_differences(time: np.ndarray) -> np.ndarray:
    """Matrix (k - 2, k) of accelerations, each weighted by the root of the time it speaks for."""
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

    A pair says where the place c goes: R(psi_j - psi_i) (c - x_i) + x_j = c + shift, and psi_j - psi_i.
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
