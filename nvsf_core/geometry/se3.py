"""Rigid motions as 4x4 float64 matrices: exponential, logarithm, inverse; rotations by yaw, pitch and roll.

A twist is (rho, phi): rho (3,) the translational part, phi (3,) the rotation vector in radians.
`exp_se3(twist)` is the motion after one unit of time at that constant twist (a screw motion).
"""

import numpy as np
import scipy  # its parts are imported when they are first used: commands need only the other functions

from nvsf_core.errors import ShapeError

_SMALL_RAD = 1e-3
"""Below this angle the Taylor series is used, which is more exact: its first dropped term is 1e-15."""


def exp_so3(rotation_vector: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3), radians about the axis."""
    sin_term, cos_term, _ = _rodrigues_terms(np.linalg.norm(rotation_vector, axis=-1))
    cross = _cross_matrix(rotation_vector)
    return np.eye(3) + sin_term[..., None, None] * cross + cos_term[..., None, None] * (cross @ cross)


def log_so3(rotation: np.ndarray) -> np.ndarray:
    """Rotation vectors (..., 3) of rotation matrices (..., 3, 3), angle in [0, pi].

    It is computed by quaternions, and so exact near 0 and near 180 degrees.
    """
    flat = np.asarray(rotation, np.float64).reshape(-1, 3, 3)
    if len(flat) == 0:
        return np.zeros(rotation.shape[:-1])
    vectors: np.ndarray = scipy.spatial.transform.Rotation.from_matrix(flat).as_rotvec()
    return vectors.reshape(rotation.shape[:-1])


def exp_se3(twist: np.ndarray) -> np.ndarray:
    """Motions (..., 4, 4) float64 of twists (..., 6) = (rho, phi).

    R = exp(phi), t = V rho with V = I + (1 - cos a)/a^2 K + (a - sin a)/a^3 K^2, a = |phi|, K = phi x.
    """
    twist = np.asarray(twist, np.float64)
    if twist.shape[-1] != 6:
        raise ShapeError(f"expected twists (..., 6), found {twist.shape}; put translation before rotation")
    rho, phi = twist[..., :3], twist[..., 3:]
    sin_term, cos_term, cubic_term = _rodrigues_terms(np.linalg.norm(phi, axis=-1))
    once = np.cross(phi, rho)
    twice = np.cross(phi, once)
    position = rho + cos_term[..., None] * once + cubic_term[..., None] * twice
    cross = _cross_matrix(phi)
    rotation = np.eye(3) + sin_term[..., None, None] * cross + cos_term[..., None, None] * (cross @ cross)
    return pose_from_parts(rotation, position)


def log_se3(pose: np.ndarray) -> np.ndarray:
    """Twists (..., 6) = (rho, phi) of rigid motions (..., 4, 4); the inverse of `exp_se3`.

    rho = V^-1 t with V^-1 = I - K/2 + (1/a^2)(1 - a sin a / (2 (1 - cos a))) K^2.
    """
    pose = _checked(pose)
    phi = log_so3(pose[..., :3, :3])
    position = pose[..., :3, 3]
    angle = np.linalg.norm(phi, axis=-1)
    safe = np.where(angle < _SMALL_RAD, 1.0, angle)
    # a sin a / (2 (1 - cos a)) = (a/2) cot(a/2), which stays finite up to and at 180 degrees.
    half_cot = 0.5 * safe * np.cos(0.5 * safe) / np.sin(0.5 * safe)
    factor = np.where(angle < _SMALL_RAD, 1.0 / 12.0 + angle**2 / 720.0, (1.0 - half_cot) / safe**2)
    once = np.cross(phi, position)
    twice = np.cross(phi, once)
    rho = position - 0.5 * once + factor[..., None] * twice
    return np.concatenate([rho, phi], axis=-1)


def invert_pose(pose: np.ndarray) -> np.ndarray:
    """Inverse (..., 4, 4) of rigid motions: R^T, -R^T t."""
    pose = _checked(pose)
    turned = np.swapaxes(pose[..., :3, :3], -1, -2)
    return pose_from_parts(turned, -(turned @ pose[..., :3, 3:])[..., 0])


def poses_in(frame: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Poses (..., 4, 4) as seen from a frame, itself a pose (4, 4) beside them: inv(frame) @ poses.

    Positions are subtracted before they are turned: far from the origin nothing is lost.
    """
    frame, poses = _checked(frame), _checked(poses)
    apart = poses[..., :3, 3] - frame[:3, 3]
    return pose_from_parts(frame[:3, :3].T @ poses[..., :3, :3], apart @ frame[:3, :3])


def pose_from_parts(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """4x4 float64 poses from rotations (..., 3, 3) and positions (..., 3) in metres."""
    pose = np.zeros((*position.shape[:-1], 4, 4))
    pose[..., :3, :3] = rotation
    pose[..., :3, 3] = position
    pose[..., 3, 3] = 1.0
    return pose


def transform_points(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (N, 3) transformed by one motion (4, 4), float64."""
    pose = _checked(pose)
    return np.asarray(points, np.float64) @ pose[:3, :3].T + pose[:3, 3]


def _rodrigues_terms(angle: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The terms sin a / a, (1 - cos a) / a^2, (a - sin a) / a^3, each exact near a = 0."""
    small = angle < _SMALL_RAD
    safe = np.where(small, 1.0, angle)
    square = angle**2
    sin_term = np.where(small, 1.0 - square / 6.0, np.sin(safe) / safe)
    # 2 sin^2(a/2) = 1 - cos a without its cancellation.
    cos_term = np.where(small, 0.5 - square / 24.0, 2.0 * np.sin(0.5 * safe) ** 2 / safe**2)
    cubic_term = np.where(small, 1.0 / 6.0 - square / 120.0, (safe - np.sin(safe)) / safe**3)
    return sin_term, cos_term, cubic_term


def _cross_matrix(vector: np.ndarray) -> np.ndarray:
    """K with K u = vector x u, shape (..., 3, 3)."""
    vector = np.asarray(vector, np.float64)
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    zero = np.zeros_like(x)
    rows = [np.stack(row, axis=-1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    return np.stack(rows, axis=-2)


def _checked(pose: np.ndarray) -> np.ndarray:
    pose = np.asarray(pose, np.float64)
    if pose.shape[-2:] != (4, 4):
        raise ShapeError(f"expected poses (..., 4, 4), found {pose.shape}; pass 4x4 matrices")
    return pose


def rotation_of(yaw_deg: float, pitch_deg: float, roll_deg: float) -> np.ndarray:
    """Rotation (3, 3) float64: yaw to the left, then pitch downwards, then roll to the right, in degrees.

    R = R_z(yaw) R_y(pitch) R_x(roll): each is about the axes that those before it gave; x forward, y left,
    z up.
    """
    yaw, pitch, roll = np.deg2rad([yaw_deg, pitch_deg, roll_deg])
    about_z = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    about_y = np.array(
        [[np.cos(pitch), 0.0, np.sin(pitch)], [0.0, 1.0, 0.0], [-np.sin(pitch), 0.0, np.cos(pitch)]]
    )
    about_x = np.array(
        [[1.0, 0.0, 0.0], [0.0, np.cos(roll), -np.sin(roll)], [0.0, np.sin(roll), np.cos(roll)]]
    )
    return about_z @ about_y @ about_x


def pose_of_angles(
    position_m: tuple[float, float, float], yaw_deg: float, pitch_deg: float, roll_deg: float
) -> np.ndarray:
    """Pose (4, 4) float64 at a position, metres, with the rotation of `rotation_of`."""
    return pose_from_parts(rotation_of(yaw_deg, pitch_deg, roll_deg), np.array(position_m, np.float64))
