"""How far a view's pixels look, as far as images alone prove that it is nearer than the sky.

A plane sweep gives every pixel some depth, the sky that of whatever is next to it. Its two images are asked
once more: only where they would differ more at the sky's distance than they do at the depth is it believed.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from nvsf_core.evidence.image_surfels import DepthRays
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.rendering.reproject_camera import (
    FAR_M,
    SweepOptions,
    box_mean,
    nearest_sources,
    render_by_warping,
)
from nvsf_core.rendering.warping import (
    plane_rays,
    ray_length,
    relative_motion,
    sample,
    shrunk,
    source_pixels,
    to_float,
)

_NOISE = 0.01
"""Mean difference of colours, of 0..1, by which the sky's distance must do worse."""


def image_depth(
    pose: np.ndarray,
    pinhole: Pinhole,
    points_m: np.ndarray,
    images: np.ndarray,
    poses: np.ndarray,
    valid: np.ndarray,
) -> DepthRays:
    """Rays of a view's shrunk pixels that two images show; none with a single image.

    Arguments as of `render_by_warping`, which gives the depths: the view's pose and camera, points that
    pull them, the images with their poses, and their pixels that show anything.
    """
    options = SweepOptions()
    factor = max(1, round(pinhole.width / options.width_px))
    small = shrunk(pinhole, factor)
    chosen = nearest_sources(pose, poses)
    if len(chosen) < 2:
        return DepthRays(
            pose[:3, 3].astype(np.float32), np.zeros((0, 3), np.float32), np.zeros(0, np.float32)
        )
    swept = render_by_warping(pose, pinhole, points_m, images, poses, source_valid=valid)
    middle = slice(factor // 2, None, factor)
    range_m = torch.from_numpy(swept.range_m[middle, middle][: small.height, : small.width].copy())
    shown = torch.from_numpy(valid).float().expand(2, 1, -1, -1)
    sources = functional.avg_pool2d(torch.cat([to_float(images[chosen]), shown], dim=1), factor)
    motions = [relative_motion(pose, poses[index]) for index in chosen]
    inverse = ray_length(torch.ones_like(range_m), small) / range_m
    near, sky = (
        _disagreement(sources, motions, depth, small, options.window_px)
        for depth in (inverse, torch.full_like(inverse, 1.0 / FAR_M))
    )
    is_known = (torch.isfinite(near) & torch.isfinite(sky)).numpy()
    proven = torch.where(sky > near + _NOISE, range_m, torch.inf).numpy()
    rays = plane_rays(small).numpy()[is_known] @ pose[:3, :3].T
    direction = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return DepthRays(pose[:3, 3].astype(np.float32), direction.astype(np.float32), proven[is_known])


def _disagreement(
    sources: Tensor, motions: Sequence[Tensor], inverse: Tensor, pinhole: Pinhole, window_px: int
) -> Tensor:
    """Mean difference (h, w) of what two sources (2, 4, h, w) show around each pixel; NaN unless both do."""
    rays, colours = plane_rays(pinhole), []
    seen = torch.ones(inverse.shape, dtype=torch.bool)
    for source, motion in zip(sources, motions, strict=True):
        grid, inside = source_pixels(motion, rays, inverse, pinhole)
        looked_up = sample(source, grid)
        colours.append(looked_up[:3])
        seen &= inside & (looked_up[3] > 0.999)
    apart = (colours[0] - colours[1]).abs().mean(dim=0)
    around = box_mean(seen * apart, window_px) / box_mean(seen.float(), window_px)
    return torch.where(seen, around, torch.nan)
