"""Depth of a camera's upward-looking pixels from images, where they prove that it is not the sky.

A plane sweep gives every pixel some depth, and so does a network that compares images; a pixel of the sky
gets that of whatever is next to it. So a depth counts as proven only where the images differ more at the
sky's distance than at that depth.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor
from torch.nn import functional

from nvsf_core.evidence.image_surfels import DepthRays
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.rendering.pixel_support import holes
from nvsf_core.rendering.rendered import RenderedImage
from nvsf_core.rendering.reproject_camera import (
    FAR_M,
    WINDOW_PX,
    box_mean,
    inverse_depth,
    nearest_sources,
    sweep_shrinking,
)
from nvsf_core.rendering.sources import SHOWN, STATIC, Sources
from nvsf_core.rendering.warping import plane_rays, relative_motion, sample, shrunk, source_pixels, to_float

_NOISE = 0.01
"""By this much, in colours 0..1, the images must differ more at the sky's distance."""
_LEAST_SHARE = 0.002
"""Share of the image that a piece of the sky has at least: leaves agree at any distance here and there."""
_MEASURED_PX = 4.0
"""Within this distance of a return in the image there is a surface, whatever images say."""


# Wide: the view (pose, pinhole), the points, the source images and the limit are independent inputs.
def image_depth(
    pose: np.ndarray,
    pinhole: Pinhole,
    points_m: np.ndarray,
    images: np.ndarray,
    poses: np.ndarray,
    valid: np.ndarray,
    *,
    up: np.ndarray,
    elevation_rad: float,
) -> DepthRays:
    """Rays of a view's steep pixels that two images show, with a range, or infinity for the sky.

    The pixels are those of the view shrunk for the plane sweep. With one image there are no rays.

    Args:
        pose: (4, 4) camera to scene-local frame.
        pinhole: Intrinsics of the view and of all images.
        points_m: (m, 3) float32, scene-local, metres: LiDAR points that the depths are pulled to.
        images: (k, H, W, 3) uint8.
        poses: (k, 4, 4) camera to scene-local frame of each image.
        valid: (H, W) bool, pixels of the images that show anything.
        up: (3,) unit normal, scene-local, of the plane that elevations are counted from.
        elevation_rad: Only rays above this elevation are returned.
    """
    nowhere = DepthRays(pose[:3, 3].astype(np.float32), np.zeros((0, 3), np.float32), np.zeros(0, np.float32))
    factor = sweep_shrinking(pinhole)
    small = shrunk(pinhole, factor)
    rays = plane_rays(small).numpy() @ pose[:3, :3].T
    direction = (rays / np.linalg.norm(rays, axis=2, keepdims=True)).astype(np.float32)
    steep = direction @ up > np.sin(elevation_rad)
    chosen = nearest_sources(pose, poses)
    if len(chosen) < 2 or not steep.any():
        return nowhere
    # Only the upper rows are swept: down to the lowest steep pixel, and the window around it.
    rows = min(small.height, int(np.flatnonzero(steep.any(axis=1))[-1]) + 1 + WINDOW_PX)
    colours = to_float(images[chosen])
    swept = inverse_depth(pose, pinhole, points_m, colours, poses[chosen], rows=rows * factor)
    middle = slice(factor // 2, None, factor)
    inverse = swept[middle, middle][:, : small.width]
    shown = torch.from_numpy(valid).float().expand(2, 1, -1, -1)
    sources = functional.avg_pool2d(torch.cat([colours, shown], dim=1), factor)
    motions = [relative_motion(pose, poses[index]) for index in chosen]
    near, sky = (
        _disagreement(sources, motions, depth, small)
        for depth in (inverse, torch.full_like(inverse, 1.0 / FAR_M))
    )
    is_known = (torch.isfinite(near) & torch.isfinite(sky)).numpy() & steep[:rows]
    range_m = torch.linalg.vector_norm(plane_rays(small)[:rows], dim=-1) / inverse
    proven = torch.where(sky > near + _NOISE, range_m, torch.inf).numpy()
    return DepthRays(nowhere.origin_m, direction[:rows][is_known], proven[is_known])


def _disagreement(sources: Tensor, motions: Sequence[Tensor], inverse: Tensor, pinhole: Pinhole) -> Tensor:
    """Mean difference (r, w) of the colours of two sources (2, 4, h, w) around each pixel of r upper rows.

    NaN unless both show the pixel at its inverse depth (r, w).
    """
    rays, colours = plane_rays(pinhole)[: len(inverse)], []
    seen = torch.ones(inverse.shape, dtype=torch.bool)
    for source, motion in zip(sources, motions, strict=True):
        grid, inside, _ = source_pixels(motion, rays, inverse, pinhole)
        looked_up = sample(source, grid)
        colours.append(looked_up[:3])
        seen &= inside & (looked_up[3] > 0.999)
    apart = (colours[0] - colours[1]).abs().mean(dim=0)
    around = box_mean(seen * apart, WINDOW_PX) / box_mean(seen.float(), WINDOW_PX)
    return torch.where(seen, around, torch.nan)


def without_sky(
    image: RenderedImage, pose: np.ndarray, pinhole: Pinhole, sources: Sources, gap_px: Tensor, *,
    label: Tensor | None = None,
) -> RenderedImage:  # fmt: skip
    """The image with infinite ranges where it shows the sky, for all that its sources tell.

    They agree there at the sky's distance as well as at the rendered one. So they do at a blank wall: apart
    from returns it loses its range, too, unless it is darker than most of the image. A sky that is as dark,
    and the little of it that leaves let through, keep the depth of what is beside them.

    Args:
        image: As rendered.
        pose: (4, 4) camera to scene-local frame.
        pinhole: Its intrinsics, and those of the sources.
        sources: The images that it was rendered from, k of them.
        gap_px: (H, W) distance to the nearest return in the image, infinite without any.
        label: (H, W) uint8, 0 = static; None = nothing moves.
    """
    rays = plane_rays(pinhole)
    grey = image.rgb.mean(axis=2)
    looks_up = rays.numpy() @ pose[2, :3].astype(np.float32) > 0.0
    may_be = torch.from_numpy(looks_up & (grey > np.median(grey))) & (gap_px > _MEASURED_PX)
    if label is not None:
        may_be = may_be & (label == STATIC)
    if not may_be.any():
        return image
    rows = int(torch.nonzero(may_be.any(dim=1))[-1]) + 1
    rays = rays[:rows]
    inverse = torch.linalg.vector_norm(rays, dim=-1) / torch.from_numpy(image.range_m[:rows])
    near, sky = (
        _spread(sources, rays, one, pinhole) for one in (inverse, torch.full_like(inverse, 1.0 / FAR_M))
    )
    may_be[:rows] &= sky <= near + _NOISE
    regions, _ = ndimage.label(holes(may_be).numpy())
    is_sky = np.bincount(regions.ravel()) >= _LEAST_SHARE * regions.size
    is_sky[0] = False
    return replace(image, range_m=np.where(is_sky[regions], np.float32(np.inf), image.range_m))


def _spread(sources: Sources, rays: Tensor, inverse: Tensor, pinhole: Pinhole) -> Tensor:
    """Mean difference (h, w), 0..1, of the sources' colours to their mean at the inverse depths (h, w), 1/m.

    Whatever hides the points in a source counts, too: which depths are right is asked. NaN unless two sources
    show the pixel.
    """
    colours, seen = list[Tensor](), list[Tensor]()
    for index, motion, nearness in zip(sources.chosen, sources.motion, sources.nearness, strict=True):
        if nearness > 0.0:
            grid, inside, _ = source_pixels(motion, rays, inverse, pinhole)
            found = sample(sources.images[index, : SHOWN + 1], grid)
            colours.append(found[:SHOWN])
            seen.append((inside & (found[SHOWN] > 0.999)).float())
    shown = torch.stack(seen)
    count = shown.sum(dim=0)
    mean = (torch.stack(colours) * shown[:, None]).sum(dim=0) / count.clamp_min(1.0)
    apart = (torch.stack(colours) - mean).abs().mean(dim=1)
    return torch.where(count > 1.5, (apart * shown).sum(dim=0) / count.clamp_min(1.0), torch.nan)
