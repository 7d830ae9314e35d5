"""Photographs of a room's corner, a wall behind a floor, from a camera that moves towards the wall."""

import numpy as np

from nvsf_core.geometry.pinhole import Pinhole

CAMERA = Pinhole(fx=150.0, fy=150.0, cx=119.5, cy=59.5, width=240, height=120)
WALL_M, FLOOR_M = 9.0, 1.5
COUNT = 6
TIME_S = np.arange(COUNT) * 0.1
TRUE = np.tile(np.eye(4), (COUNT, 1, 1))
TRUE[:, 2, 3] = 0.5 * np.arange(COUNT)


def _seen(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (h, w, 3) that a camera sees of a wall and of the floor before it, and what they look like."""
    rays = CAMERA.rays(CAMERA.pixels())
    rays = rays / rays[..., 2:] @ pose[:3, :3].T
    to_wall = (WALL_M - pose[2, 3]) / rays[..., 2]
    to_floor = np.where(rays[..., 1] > 1e-3, (FLOOR_M - pose[1, 3]) / np.maximum(rays[..., 1], 1e-3), np.inf)
    point = pose[:3, 3] + rays * np.minimum(to_wall, to_floor)[..., None]
    x, y, z = np.moveaxis(point, -1, 0)
    wave = np.sin(3.1 * x + 1.3 * z) + np.sin(2.3 * y - 1.1 * x + 0.7) + np.sin(2.7 * z + 2.1 * x + 1.9)
    grey = np.round(127.0 + 40.0 * wave).astype(np.uint8)
    return point, np.repeat(grey[..., None], 3, axis=-1)


SEEN = [_seen(pose) for pose in TRUE]
RGB = np.stack([image for _, image in SEEN])
