"""All pixels that are trained on, and the rays behind those that a step draws."""

from dataclasses import dataclass

import numpy as np
import torch

from nvsf_core.geometry.pinhole import Pinhole


@dataclass(frozen=True, slots=True)
class CameraImages:
    """The training images of one camera."""

    pinhole: Pinhole
    rgb: np.ndarray
    """(n, h, w, 3) uint8."""
    pose: np.ndarray
    """(n, 4, 4) float64 camera to scene-local."""
    pixel: np.ndarray
    """(m,) int64: numbers row * w + column of the pixels that show anything."""


def draw_pixels(
    cameras: list[CameraImages], count: int, generator: torch.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw pixels evenly over all images of all cameras.

    Returns:
        origin_m (count, 3), unit direction (count, 3), scene-local float32; colour (count, 3) float32 0..1.
    """
    sizes = np.array([len(camera.rgb) * len(camera.pixel) for camera in cameras])
    drawn = torch.randint(int(sizes.sum()), (count,), generator=generator).numpy()
    ends = np.cumsum(sizes)
    parts = []
    for camera, start, end in zip(cameras, ends - sizes, ends, strict=True):
        mine = drawn[(drawn >= start) & (drawn < end)] - start
        image, pixel = mine // len(camera.pixel), camera.pixel[mine % len(camera.pixel)]
        row, column = pixel // camera.pinhole.width, pixel % camera.pinhole.width
        direction = camera.pinhole.rays(np.stack([column, row], axis=1).astype(np.float64))
        direction = np.einsum("nij,nj->ni", camera.pose[image, :3, :3], direction)
        parts.append((camera.pose[image, :3, 3], direction, camera.rgb[image, row, column] / 255.0))
    origin, direction, colour = (
        np.concatenate(columns).astype(np.float32) for columns in zip(*parts, strict=True)
    )
    return origin, direction, colour
