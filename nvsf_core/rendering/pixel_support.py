"""Pixels of a rendered image: which of them recorded images show, from how far; colours for the others."""

import math

import torch
from torch import Tensor
from torch.nn import functional

from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.rendering.camera_view import CameraView
from nvsf_core.rendering.rendered import Support
from nvsf_core.rendering.sources import DEPTH, STATIC, Neighbours, SeenPoints, Sources, hides, look_up
from nvsf_core.rendering.warping import plane_rays, sample, source_pixels

_MOST_ANGLE_RAD = 0.1
"""An image sees a point as the view does if it looks at it from a direction that differs by at most this,"""
_MOST_RATIO = 1.5
"""and from a distance that differs by at most this factor."""
_BESIDE_PX = 8.0
"""Within this distance of a return the LiDAR tells the depth of a pixel that no depth map shows."""
_HOLE_PX = 5
"""Side of the smallest square that is a hole: at depth edges no map has a surface, but both sides have."""


def pixel_support(view: CameraView, inverse: Tensor, shown: Tensor) -> Tensor:
    """(H, W) uint8 class of `Support` of each pixel of a view, whose images have depths.

    Guessed is where no image shows anything; seen is what one of the view's k sources shows, `shown` (k, H,
    W) bool, from about the view's direction and distance; all else is extrapolated. `inverse` (H, W), 1/m, is
    of what is shown.
    """
    assert view.surfaces is not None
    rays = plane_rays(view.pinhole)
    point_m = (rays / inverse[..., None].clamp_min(1e-4)).permute(2, 0, 1).contiguous()
    seen = torch.zeros_like(inverse, dtype=torch.bool)
    moved = None if view.label is None else view.near.moved
    for number, motion in enumerate(view.near.motion):
        alike = _looked_at_alike(point_m, motion)
        for mover in range(0 if moved is None else len(moved)):
            assert moved is not None and view.label is not None
            own = _looked_at_alike(point_m, moved[mover, number])
            alike = torch.where(view.label == mover + 1, own, alike)
        seen |= shown[number] & alike
    support = torch.where(seen, int(Support.SEEN), int(Support.EXTRAPOLATED))
    unknown = (view.surfaces.support[0] == 0.0) & (view.surfaces.label == STATIC)
    is_hole = holes(unknown & ~_glimpsed(view, unknown))
    return torch.where(is_hole, int(Support.GUESSED), support).to(torch.uint8)


def _glimpsed(view: CameraView, unknown: Tensor) -> Tensor:
    """(H, W) bool: which `unknown` pixels some image shows, though no map has a confirmed surface there.

    Beside a return the depth is known, and the images are asked whether they show just that surface;
    elsewhere an unconfirmed depth of any image counts.
    """
    assert view.surfaces is not None and view.images.depths is not None
    measured = unknown & (view.gap_px <= _BESIDE_PX)
    rays = plane_rays(view.pinhole)[measured][:, None]
    points = SeenPoints(rays, view.inverse[measured][None, :, None])
    is_shown = torch.zeros_like(measured[measured])
    maps = view.images.depths.inverse
    for images in (view.near, view.others):
        if images is not None and len(is_shown) > 0:
            is_shown |= _shows_surface(images, maps, points, view.pinhole).any(dim=0)[:, 0]
    glimpsed = view.surfaces.glimpsed.clone()
    glimpsed[measured] = is_shown
    return glimpsed


def _shows_surface(
    images: Neighbours | Sources, maps: Tensor, points: SeenPoints, pinhole: Pinhole
) -> Tensor:
    """(k, h, w) bool: images whose own depth maps have a surface at the first point of each pixel.

    That is more than not to hide a point: where an image's map knows nothing, it may show anything. Of the
    maps (j, H, W) of all images, 1/m, 0 = unknown, negative = unconfirmed, which counts, too.
    """
    found = []
    for number, image in enumerate(images.chosen):
        grid, inside, there = source_pixels(images.motion[number], points.rays, points.inverse[0], pinhole)
        own = sample(maps[image][None], grid, "nearest")[0].abs()
        found.append(inside & (own > 0.0) & ~hides(own, there) & ~hides(there, own))
    return torch.stack(found)


def _looked_at_alike(point_m: Tensor, motion: Tensor) -> Tensor:
    """(H, W) bool: points (3, H, W) of a view at which a source, `motion` (4, 4) away, looks as it does."""
    x, y, z = point_m
    away = motion[:3, :3].T @ motion[:3, 3]
    along = x * away[0] + y * away[1] + z * away[2]
    # Squares of the distances from the view and from the source; and the product of both directions.
    near = x * x + y * y + z * z
    far, both = near + 2.0 * along + away.square().sum(), near + along
    is_alike = both >= math.cos(_MOST_ANGLE_RAD) * (near * far).sqrt()
    return is_alike & (far <= _MOST_RATIO**2 * near) & (near <= _MOST_RATIO**2 * far)


def holes(unknown: Tensor) -> Tensor:
    """(H, W) bool: the part of `unknown` (H, W) that squares of `_HOLE_PX` pixels within it cover."""
    whole = -_grown(-unknown.float())
    return _grown(whole) > 0.5


def _grown(image: Tensor) -> Tensor:
    """Largest value (H, W) of an image in the square around each pixel."""
    half = _HOLE_PX // 2
    rows = functional.max_pool2d(image[None], (_HOLE_PX, 1), 1, (half, 0))
    return functional.max_pool2d(rows, (1, _HOLE_PX), 1, (0, half))[0]


def shown_by_others(
    others: Sources | None, points: SeenPoints, pinhole: Pinhole, missing: Tensor
) -> tuple[Tensor, Tensor]:
    """Mean colours (3, m) of pixels in images that are no sources, nearer ones counting more.

    Of the m `missing` (h, w) bool pixels. Few sources are chosen, those that show most of a view; what a
    moving object hides in all of them, others may show. They must have the very surface, the first of each
    pixel's points, in their own depth maps. And whether any image shows them (m,) bool; colours of others
    mean nothing.
    """
    count = int(missing.sum())
    if others is None or count == 0:
        return torch.zeros(3, count), torch.zeros_like(missing[missing])
    label = None if points.label is None else points.label[missing][:, None]
    front = SeenPoints(points.rays[missing][:, None], points.inverse[:1, missing][..., None], label)
    colour, shown = look_up(others, front, pinhole)
    is_it = _shows_surface(others, others.images[:, DEPTH], front, pinhole)
    if label is not None:
        is_it = is_it | (label != STATIC)
    weight = (shown[:, 0] & is_it)[..., 0] * others.nearness.square()[:, None]
    whole = weight.sum(dim=0)
    return (colour[:, :, 0, :, 0] * weight[:, None]).sum(dim=0) / whole.clamp_min(1e-9), whole > 0.0


def without_holes(colour: Tensor, share: Tensor) -> Tensor:
    """Colours (3, h, w) that are known for a `share` (h, w), the rest from ever larger surroundings."""
    return _filled(colour * share, share)


def _filled(weighted: Tensor, share: Tensor) -> Tensor:
    both = torch.cat([weighted, share[None]])
    if min(share.shape) < 2:
        mean = both.mean(dim=(1, 2), keepdim=True)
        around = mean[:3] / mean[3:].clamp_min(1e-6)
    else:
        smaller = functional.avg_pool2d(both[None], 2, ceil_mode=True, count_include_pad=False)[0]
        coarse = _filled(smaller[:3], smaller[3])
        around = functional.interpolate(coarse[None], share.shape, mode="bilinear", align_corners=False)[0]
    return weighted + (1.0 - share) * around
