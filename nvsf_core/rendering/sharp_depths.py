"""Depth maps of recorded images, sharpened: their edges are where the images have them.

Networks compare images that are shrunk. At full size a pixel beside an edge chooses which of the surfaces
around it other images confirm, and afterwards the maps of all images are asked whether they agree.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.geometry.se3 import invert_pose
from nvsf_core.kernels.images.depth_refinement import confirmed, likeliest_surface
from nvsf_core.kernels.images.source_lookup import least_differences
from nvsf_core.rendering.lidar_view import LidarView
from nvsf_core.rendering.sources import SeenPoints, Sources, kernel_inputs
from nvsf_core.rendering.view_depth_maps import image_motions
from nvsf_core.rendering.warping import plane_rays

COMPARED = 6
"""Images that a pixel is looked up in, at growing distances: what some of them hide others show."""
ASKED = 8
"""Images whose depth maps are asked whether they agree."""
_REACHES_PX = (3, 2)
"""A pixel chooses of the surfaces within this distance, then once more."""
_BESIDE_PX = 30.0
"""Beyond this distance from a return its depth is no candidate."""
_DISTINCT_SHARE, _DISTINCT_PER_M = 0.08, 0.002
"""Depths are of two surfaces if the inverse ones differ by more than this share plus so much, 1/m."""
_FRONT = np.float32(1e9)
"""Inverse depth, 1/m, of nothing: no surface is as near."""
_UNSEEN_DIFFERENCE = 0.06
"""Difference of colours that is assumed where no other image shows a point, and the largest that counts."""


def sharpened(
    inverse: np.ndarray, own: np.ndarray, lidar: LidarView, sources: Sources, pinhole: Pinhole
) -> np.ndarray:
    """A recorded image's depth map, in which each pixel shows the surface that other images confirm.

    A pixel chooses between its own depth, those of the nearest and the farthest surface around it, and that
    of the nearest return.

    Args:
        inverse: (H, W) float32 inverse depths of what is static, 1/m; 0 = unknown.
        own: (H, W, c) float32: the image, channels as of `Sources.images`.
        lidar: What returns show in the image.
        sources: The images that it is compared with.
        pinhole: Intrinsics of all images.

    Returns:
        (H, W) float32, 1/m; known where `inverse` or anything around it is.
    """
    returns = np.where(lidar.gap_px.numpy() <= _BESIDE_PX, lidar.inverse.numpy(), np.float32(0.0))
    for reach_px in _REACHES_PX:
        back = _around(np.minimum, np.where(inverse > 0.0, inverse, _FRONT), reach_px)
        front = _around(np.maximum, inverse, reach_px)
        around = (front, np.where(back < _FRONT, back, np.float32(0.0)), returns)
        layers = np.stack([inverse, *(_other(inverse, one) for one in around)])
        points = SeenPoints(plane_rays(pinhole), torch.from_numpy(layers))
        where = kernel_inputs(sources, points, pinhole)
        inverse = likeliest_surface(own, layers, least_differences(where, own, _UNSEEN_DIFFERENCE))
    return inverse


def static_sources(images: Tensor, chosen: list[int], poses: np.ndarray, own: int) -> Sources:
    """Images (j, c, H, W) as sources of what is static in the image `own`; poses (j, 4, 4) are of all."""
    motion = image_motions(poses[own], poses[chosen], [])[0]
    return Sources(images, chosen, torch.from_numpy(motion.astype(np.float32)), torch.ones(len(chosen)))


def _around(extreme: np.ufunc, image: np.ndarray, reach_px: int) -> np.ndarray:
    """The minimum or maximum (H, W) over the square around each pixel, as scipy's filters in a tenth of time.

    A side is `reach_px` pixels on either side of the middle; `extreme` is `np.minimum` or `np.maximum`.
    """
    found = np.pad(image, reach_px, mode="edge")
    for _ in range(2):
        joined, side = 1, 2 * reach_px + 1
        while joined < side:
            step = min(joined, side - joined)
            found = extreme(found[:-step], found[step:])
            joined += step
        found = found.T
    return np.ascontiguousarray(found)


def _other(inverse: np.ndarray, candidate: np.ndarray) -> np.ndarray:
    """Inverse depths (H, W), 1/m, of candidates for each pixel; its own where both are of one surface."""
    nearer, farther = np.maximum(inverse, candidate), np.minimum(inverse, candidate)
    is_own = nearer <= farther * np.float32(1.0 + _DISTINCT_SHARE) + np.float32(_DISTINCT_PER_M)
    return np.where((inverse > 0.0) & is_own, inverse, candidate)


def agreed(
    inverse: np.ndarray, own: int, others: Sequence[int], maps: np.ndarray, poses: np.ndarray,
    is_static: np.ndarray, pinhole: Pinhole,
) -> np.ndarray:  # fmt: skip
    """A depth map (H, W), 1/m; negative where no other map confirms a static depth.

    Args:
        inverse: (H, W) float32 of the image, 1/m.
        own: Its number.
        others: Numbers of the images that are asked.
        maps: (j, H, W) float32 inverse depths of all images, 1/m.
        poses: (j, 4, 4) camera to scene-local frame of all images.
        is_static: (H, W) bool: pixels that are asked about.
        pinhole: Intrinsics of all images.
    """
    matrix = np.array([[pinhole.fx, 0.0, pinhole.cx], [0.0, pinhole.fy, pinhole.cy], [0.0, 0.0, 1.0]])
    motions = matrix @ (invert_pose(poses[list(others)]) @ poses[own])[:, :3]
    motions[:, :, :3] = motions[:, :, :3] @ np.linalg.inv(matrix)
    asked = np.ascontiguousarray(maps[list(others)])
    return confirmed(inverse, motions.astype(np.float32), asked, is_static)
