"""Rotations by yaw, pitch and roll, in axes x forward, y left, z up."""

import numpy as np

from nvsf_core.geometry.se3 import pose_from_parts


def rotation_of(yaw_deg: float, pitch_deg: float, roll_deg: float) -> np.ndarray:
    """Rotation (3, 3) float64: yaw to the left, then pitch downwards, then roll to the right, in degrees.

    R = R_z(yaw) R_y(pitch) R_x(roll): each is about the axes that those before it gave.
    """
    yaw, pitch, roll = np.deg2rad([yaw_deg, pitch_deg, roll_deg])
    about_z = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    about_y = np.array(
        [[np.cos(pitch), 0.0, np.sin(pitch)], [0.0, 1.0, 0.0], [-np.sin(pitch), 0.0, np.cos(pitch)]]
    )
    about_x = np.array(
        [[1.0, 0.0, 0.0], [0.0, np.cos(roll), -np.sin(roll)], [0.0, np.sin(roll), np.cos(roll)]]
    )
    turned: np.ndarray = about_z @ about_y @ about_x
    return turned


def pose_of_angles(
    position_m: tuple[float, float, float], yaw_deg: float, pitch_deg: float, roll_deg: float
) -> np.ndarray:
    """Pose (4, 4) float64 at a position, metres, with the rotation of `rotation_of`."""
    return pose_from_parts(rotation_of(yaw_deg, pitch_deg, roll_deg), np.array(position_m, np.float64))
