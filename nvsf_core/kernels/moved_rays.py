"""The rays of a sweep from the sensor into the scene: pitch correction, mounting, motion; in numba."""

import math

import numpy as np
from numba import njit, prange


@njit(inline="always")
def _turned_up(x, y, z, cos_a, sin_a, cos_up, sin_up):  # type: ignore[no-untyped-def]
    """A vector turned up within the plane of its azimuth a."""
    level, left = x * cos_a + y * sin_a, y * cos_a - x * sin_a
    ahead, up = level * cos_up - z * sin_up, level * sin_up + z * cos_up
    return ahead * cos_a - left * sin_a, ahead * sin_a + left * cos_a, up


@njit(parallel=True, cache=True, nogil=True)
def move_sweep(  # type: ignore[no-untyped-def]
    origin_m, direction, azimuth_rad, angle_rad, mount, rotation, position_m
):
    """Rays of l lasers x f firings in the scene.

    Each is turned up by `angle_rad` about the sensor's centre within its azimuth's plane (as by `turn_up`),
    set into the recording sensor's frame by `mount` (4, 4), and moved by its firing's pose.

    Args:
        origin_m: (l, f, 3) float64 in the sensor's frame.
        direction: (l, f, 3) float64.
        azimuth_rad: (l, f) encoder's angles.
        angle_rad: The table's elevation correction.
        mount: (4, 4) float64.
        rotation: (f, 3, 3) float64.
        position_m: (f, 3) float64, scene-local.

    Returns:
        Origins and directions, (l * f, 3) float32.
    """
    lasers, firings = azimuth_rad.shape
    origins = np.empty((lasers * firings, 3), np.float32)
    directions = np.empty((lasers * firings, 3), np.float32)
    cos_up, sin_up = math.cos(angle_rad), math.sin(angle_rad)
    for laser in prange(lasers):
        for firing in range(firings):
            row = laser * firings + firing
            cos_a, sin_a = math.cos(azimuth_rad[laser, firing]), math.sin(azimuth_rad[laser, firing])
            ox, oy, oz = _turned_up(
                origin_m[laser, firing, 0], origin_m[laser, firing, 1], origin_m[laser, firing, 2],
                cos_a, sin_a, cos_up, sin_up,
            )  # fmt: skip
            dx, dy, dz = _turned_up(
                direction[laser, firing, 0], direction[laser, firing, 1], direction[laser, firing, 2],
                cos_a, sin_a, cos_up, sin_up,
            )  # fmt: skip
            for i in range(3):
                origin, towards = position_m[firing, i], 0.0
                for j in range(3):
                    turn = rotation[firing, i, j]
                    origin += turn * (mount[j, 0] * ox + mount[j, 1] * oy + mount[j, 2] * oz + mount[j, 3])
                    towards += turn * (mount[j, 0] * dx + mount[j, 1] * dy + mount[j, 2] * dz)
                origins[row, i] = origin
                directions[row, i] = towards
    return origins, directions
