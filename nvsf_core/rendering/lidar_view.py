"""What LiDAR returns show in a view of a camera: depth, and the moving object that a pixel belongs to."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.rendering.reproject_camera import filled_depth, splat_points, view_label

_REACH_PX = 6.0
"""Pixels within this distance of a moving object's return are labelled as the object."""
_SHADOW_PX = 10.0
"""The same distance in source images, where such pixels must not be used for static surfaces."""


@dataclass(frozen=True, slots=True, eq=False)
class MovingPoints:
    """Points of a moving object at a view's instant, and its motion to each image's instant."""

    number: int
    """Of the object, from 1, the same in all views and in `DepthMaps.mover`."""

    points_m: np.ndarray
    """(m, 3) float32, scene-local, metres, at the view's instant."""
    moved: np.ndarray
    """(j, 4, 4) rigid motion in the scene from that instant to each image's; zeros where it is unknown."""


@dataclass(frozen=True, slots=True)
class LidarView:
    """Returns, seen by a camera."""

    inverse: Tensor
    """(H, W) float32 inverse depth along z of the return nearest in the image, 1/m; positive."""
    gap_px: Tensor
    """(H, W) float32 distance to it in the image; inf if the camera sees no return."""
    label: Tensor
    """(H, W) uint8: 0 = static, else the place, from 1, of the moving object among those that were given."""


def lidar_view(
    pose: np.ndarray, pinhole: Pinhole, static_m: np.ndarray, moving: Sequence[MovingPoints]
) -> LidarView:
    """What static returns (m, 3), scene-local metres, and moving objects show in a view at `pose` (4, 4)."""
    clouds = [static_m, *(each.points_m for each in moving)]
    points_m = np.concatenate(clouds)
    sparse = splat_points(pose, pinhole, points_m)
    depth_m, gap_px = filled_depth(pose, pinhole, points_m, sparse)
    label = np.zeros(sparse.shape, np.uint8)
    if moving:
        label = view_label(pose, pinhole, clouds, sparse, _REACH_PX)
    return LidarView(torch.from_numpy(1.0 / depth_m), torch.from_numpy(gap_px), torch.from_numpy(label))


def moving_pixels(
    pose: np.ndarray, pinhole: Pinhole, static_m: np.ndarray, moving_m: Sequence[np.ndarray]
) -> np.ndarray:
    """Which pixels of a recorded image may show a moving object.

    Args:
        pose: (4, 4) camera to scene-local frame.
        pinhole: Intrinsics of the image.
        static_m: (m, 3) float32 static points, scene-local, metres.
        moving_m: (m, 3) float32 points of each moving object at the image's instant.

    Returns:
        (H, W) bool.
    """
    clouds = [static_m, *moving_m]
    sparse = splat_points(pose, pinhole, np.concatenate(clouds))
    return view_label(pose, pinhole, clouds, sparse, _SHADOW_PX) > 0
