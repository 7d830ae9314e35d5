"""Camera rendering without training: recorded images, warped into the view by the LiDAR's depth.

Depth comes from aggregated returns through a z-buffer; points behind the neighbourhood of a nearer surface
are dropped. A pixel without a return has the depth of the nearest return in the image. Far from any return a
plane sweep between the two source images corrects that guess.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from nvsf_core.errors import ShapeError
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.geometry.se3 import invert_pose
from nvsf_core.kernels.images.filling import median_of_7, nearest_known
from nvsf_core.kernels.images.local_planes import on_planes
from nvsf_core.kernels.images.splat import mean_places, splat_depth
from nvsf_core.rendering.rendered import RenderedImage
from nvsf_core.rendering.warping import (
    plane_rays,
    ray_length,
    relative_motion,
    sample,
    shrunk,
    source_pixels,
    to_float,
)

FAR_M = 300.0
"""Depth of the sky, and of all pixels in a drive without LiDAR."""
_NEAREST_PLANE_M = 3.0
_PLANES = 48
"""Depths of the plane sweep, evenly spaced in inverse depth from 3 m to 300 m."""
_SWEEP_WIDTH_PX = 704
"""The plane sweep compares images shrunk by a whole number to about this width, for speed."""
WINDOW_PX = 17
"""Side of the square over which the two shrunk images are compared."""
_FITTED_PX = 6.0
"""Pixels nearer than this to a return have their depth from a plane through the returns around."""
_BEYOND_PX = 3.0
"""Pixels nearer than this to a return keep the LiDAR's depth."""
_PULL = 0.15
"""Cost of a difference to the filled depth: grey values (0..1) for the whole span of inverse depths."""
_UNSEEN_COST = 0.5
"""Difference in grey value that is assumed where one of two images does not show a candidate."""
_BASELINE_FLOOR_M = 0.05
"""Nearer images count as taken at the same place."""
OTHER_WAY = -0.5
"""Cosine of the angle between two axes: beyond 120 degrees cameras show nothing of what the other does."""
_FARTHER_M = 8.0
"""A road's other lane is nearer, and images of one's own are not farther apart."""


def sweep_shrinking(pinhole: Pinhole) -> int:
    """By how much images of a camera are shrunk for the plane sweep."""
    return max(1, round(pinhole.width / _SWEEP_WIDTH_PX))


def render_by_warping(
    target_pose: np.ndarray,
    pinhole: Pinhole,
    depth_points_local: np.ndarray,
    source_images: np.ndarray,
    source_poses: np.ndarray,
    *,
    source_valid: np.ndarray | None = None,
    sweep: bool = True,
) -> RenderedImage:
    """Render a view by warping the two source images nearest to it.

    A pixel is the mean of both, weighted by the inverse of their cameras' distances to the view; where only
    one shows it, that one's value; where none does, black.

    Args:
        target_pose: (4, 4) camera to scene-local frame, of the view.
        pinhole: Intrinsics of the view and of all sources.
        depth_points_local: (M, 3) float32 points in the scene-local frame, metres; M may be 0.
        source_images: (k, H, W, 3) uint8, k >= 1.
        source_poses: (k, 4, 4) camera to scene-local frame.
        source_valid: (H, W) bool, pixels of the sources that show anything; None = all.
        sweep: Find depth far from returns by a plane sweep; False = keep the nearest return's depth.

    Raises:
        ShapeError: There is no source, or the arrays do not fit each other.
    """
    _check(pinhole, source_images, source_poses)
    chosen = nearest_sources(target_pose, source_poses)
    images = to_float(source_images[chosen])
    motions = [relative_motion(target_pose, source_poses[i]) for i in chosen]
    if source_valid is None:
        source_valid = np.ones((pinhole.height, pinhole.width), np.bool_)
    valid = torch.from_numpy(source_valid).float()[None]
    rays = plane_rays(pinhole)
    inverse = inverse_depth(
        target_pose, pinhole, depth_points_local, images, source_poses[chosen], sweep=sweep
    )
    total = torch.zeros(3, pinhole.height, pinhole.width)
    weight = torch.zeros(pinhole.height, pinhole.width)
    for image, motion, index in zip(images, motions, chosen, strict=True):
        grid, seen, _ = source_pixels(motion, rays, inverse, pinhole)
        seen = seen & (sample(valid, grid)[0] > 0.999)
        share = seen / (_distance(target_pose, source_poses[index]) + _BASELINE_FLOOR_M)
        total += share * sample(image, grid)
        weight += share
    rgb = torch.where(weight > 0, total / weight.clamp_min(1e-12), 0.0)
    rgb_u8 = (rgb * 255.0).round().clamp(0, 255).to(torch.uint8)
    return RenderedImage(rgb_u8.permute(1, 2, 0).contiguous().numpy(), ray_length(inverse, pinhole).numpy())


def inverse_depth(
    target_pose: np.ndarray,
    pinhole: Pinhole,
    depth_points_local: np.ndarray,
    images: Tensor,
    source_poses: np.ndarray,
    *,
    sweep: bool = True,
    rows: int | None = None,
) -> Tensor:
    """Inverse depth (rows, W) along z, 1/m, of a view's upper rows.

    Args:
        target_pose: (4, 4) camera to scene-local frame, of the view.
        pinhole: Intrinsics of the view and of all sources.
        depth_points_local: (M, 3) float32 points in the scene-local frame, metres; M may be 0.
        images: (k, 3, H, W) float32 in 0..1; swept if k is 2.
        source_poses: (k, 4, 4) camera to scene-local frame.
        sweep: Find depth far from returns by a plane sweep; False = keep the nearest return's depth.
        rows: Number of upper rows; None = all. The lowest of them are less exact, as points below them are
            ignored: ask for some more.
    """
    seen = splat_points(target_pose, pinhole, depth_points_local, rows)
    depth_m, gap_px = filled_depth(target_pose, pinhole, depth_points_local, seen)
    inverse = torch.from_numpy(1.0 / depth_m)
    if not sweep or len(images) != 2 or _distance(*source_poses) <= _BASELINE_FLOOR_M:
        return inverse
    motions = [relative_motion(target_pose, one) for one in source_poses]
    return _sweep(images, motions, pinhole, inverse, torch.from_numpy(gap_px))


def nearest_sources(target_pose: np.ndarray, source_poses: np.ndarray, most: int = 2) -> list[int]:
    """Indices of the at most `most` of k cameras nearest to a view, the nearest first; ties keep their order.

    Poses (4, 4) and (k, 4, 4) are camera to scene-local. Those that look the other way count as some metres
    farther away: where a road is driven there and back, they are near and show nothing of it.
    """
    distances = np.linalg.norm(source_poses[:, :3, 3] - target_pose[:3, 3], axis=1)
    looks_back = source_poses[:, :3, 2] @ target_pose[:3, 2] < OTHER_WAY
    return [int(i) for i in np.argsort(distances + _FARTHER_M * looks_back, kind="stable")[:most]]


def filled_depth(
    pose: np.ndarray, pinhole: Pinhole, points_m: np.ndarray, sparse: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Depth of every pixel of a view, from that (H, W) of the points (m, 3) that it shows, inf between them.

    Returns:
        `depth_m` (H, W) float32 along z, positive and finite: that of the visible point nearest in the image;
        and `gap_px` (H, W) float32, the distance to it, inf if no point is visible.
    """
    known = np.isfinite(sparse)
    if not known.any():
        return np.full(sparse.shape, FAR_M, np.float32), np.full(sparse.shape, np.inf, np.float32)
    gap_px, where = nearest_known(known)
    filled = np.minimum(sparse[where[0], where[1]], np.float32(FAR_M))
    # Leaves and range noise make depth jump from pixel to pixel, which tears the image; the median evens that
    # out and keeps edges (0.6 dB on held-back training images of a real street). It tells which surface a
    # pixel shows; where on it the pixel's centre lies, the points around say.
    guess = np.float32(1.0) / median_of_7(filled)
    places = mean_places(points_m, invert_pose(pose), _intrinsics(pinhole), sparse)
    fitted = on_planes(places, guess, gap_px <= _FITTED_PX)
    return np.float32(1.0) / np.maximum(fitted, np.float32(1.0 / FAR_M)), gap_px


def view_label(
    target_pose: np.ndarray,
    pinhole: Pinhole,
    clouds: Sequence[np.ndarray],
    sparse: np.ndarray,
    reach_px: float,
) -> np.ndarray:
    """Which of several clouds of points each pixel of a view shows: that of the nearest visible point.

    Args:
        target_pose: (4, 4) camera to scene-local frame, of the view.
        pinhole: Intrinsics of the view.
        clouds: (m, 3) float32 each, scene-local, metres; the first is the static one.
        sparse: (H, W) float32 depth of the points of all clouds together, as `splat_points` gives it.
        reach_px: Largest distance in the image from a pixel to its point.

    Returns:
        (H, W) uint8 number of the cloud; also 0 where no point is visible within `reach_px`.
    """
    label = np.zeros((pinhole.height, pinhole.width), np.uint8)
    each = np.stack([splat_points(target_pose, pinhole, cloud) for cloud in clouds])
    rows, columns = (np.flatnonzero(np.isfinite(each[1:]).any(axis=(0, axis))) for axis in (2, 1))
    if len(rows) == 0:
        return label
    # Farther away nothing can be within reach of a pixel that is within reach of such a point.
    rim = 2 * math.ceil(reach_px)
    part = tuple(slice(max(0, side[0] - rim), side[-1] + 1 + rim) for side in (rows, columns))
    known = np.isfinite(sparse[part])
    if not known.any():
        return label
    owner = np.argmin(each[:, *part], axis=0).astype(np.uint8)
    gap_px, where = nearest_known(known)
    label[part] = np.where(gap_px <= reach_px, owner[where[0], where[1]], 0)
    return label


def splat_points(
    pose: np.ndarray, pinhole: Pinhole, points_m: np.ndarray, rows: int | None = None
) -> np.ndarray:
    """Depth (H, W) float32 in metres along z of the points (m, 3) that a view shows, inf between them.

    `rows`: of so many upper rows only.
    """
    shape = pinhole.height if rows is None else rows, pinhole.width
    return splat_depth(points_m, invert_pose(pose), _intrinsics(pinhole), shape)


def _intrinsics(pinhole: Pinhole) -> tuple[float, float, float, float]:
    return pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy


def _sweep(
    images: Tensor, motions: list[Tensor], pinhole: Pinhole, inverse: Tensor, gap_px: Tensor
) -> Tensor:
    """Inverse depth (h, W) of the upper rows, with that on which both images agree best far from returns."""
    factor = sweep_shrinking(pinhole)
    small = shrunk(pinhole, factor)
    grey = functional.avg_pool2d(images.mean(dim=1, keepdim=True), factor)
    size = (len(inverse) // factor, small.width)
    prior = functional.interpolate(inverse[None, None], size, mode="nearest")[0, 0]
    rays = plane_rays(small)[: size[0]]
    # Without any return the filled depth is a placeholder: a pull towards it cost 0.6 dB on a real street.
    pull = _PULL if bool(torch.isfinite(gap_px).any()) else 0.0
    span = 1.0 / _NEAREST_PLANE_M - 1.0 / FAR_M
    best_cost = torch.full_like(prior, torch.inf)
    best = prior
    for plane in torch.linspace(1.0 / FAR_M, 1.0 / _NEAREST_PLANE_M, _PLANES):
        candidate = plane.expand(size)
        seen_by_both = torch.ones(size, dtype=torch.bool)
        warped = []
        for image, motion in zip(grey, motions, strict=True):
            grid, seen, _ = source_pixels(motion, rays, candidate, small)
            warped.append(sample(image, grid)[0])
            seen_by_both &= seen
        difference = torch.where(seen_by_both, (warped[0] - warped[1]).abs(), _UNSEEN_COST)
        cost = box_mean(difference, WINDOW_PX) + pull * (plane - prior).abs() / span
        better = cost < best_cost
        best_cost = torch.where(better, cost, best_cost)
        best = torch.where(better, candidate, best)
    found = functional.interpolate(best[None, None], tuple(inverse.shape), mode="nearest")[0, 0]
    return torch.where(gap_px > _BEYOND_PX, found, inverse)


def box_mean(image: Tensor, side: int) -> Tensor:
    """Mean of an image (h, w) over a square window of that side in pixels, one axis after the other."""
    half = side // 2
    rows = functional.avg_pool2d(image[None, None], (side, 1), 1, (half, 0), count_include_pad=False)
    return functional.avg_pool2d(rows, (1, side), 1, (0, half), count_include_pad=False)[0, 0]


def _distance(first: np.ndarray, second: np.ndarray) -> float:
    """Distance in metres between two cameras, by their poses (4, 4)."""
    return float(np.linalg.norm(first[:3, 3] - second[:3, 3]))


def _check(pinhole: Pinhole, images: np.ndarray, poses: np.ndarray) -> None:
    count = len(images)
    shape = (count, pinhole.height, pinhole.width, 3)
    if count == 0 or images.shape != shape or poses.shape != (count, 4, 4):
        raise ShapeError(
            f"expected k >= 1 source images (k, {pinhole.height}, {pinhole.width}, 3) and poses (k, 4, 4), "
            f"found {images.shape} and {poses.shape}"
        )
