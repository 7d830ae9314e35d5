"""Rendering of camera views: recorded images, looked up on a view's surfaces and blended."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nvsf_core.kernels.images.blend import blended
from nvsf_core.kernels.images.source_agreement import source_trust
from nvsf_core.kernels.images.source_shifts import brought_together
from nvsf_core.rendering.camera_view import CameraView, places_in_small
from nvsf_core.rendering.image_exposure import at_exposure
from nvsf_core.rendering.pixel_support import holes, pixel_support, shown_by_others, without_holes
from nvsf_core.rendering.plane_volume import agreement
from nvsf_core.rendering.rendered import RenderedImage
from nvsf_core.rendering.sources import SeenPoints, Sources, kernel_inputs, look_up
from nvsf_core.rendering.warping import plane_rays, ray_length, sample

_TRUST_PX = 2.0
"""Over this distance from a return the trust in the LiDAR's depth falls to 1/e: farther away the images'
depth maps are better, which know the returns of all scans."""
_ON_PATH_M, _OFF_PATH_M = 1.0, 3.0
"""A view up to so far from the path is as soft as makes its squared errors least, one from so far as sharp as
its sources (decision 0055)."""


@dataclass(frozen=True, slots=True)
class Hypotheses:
    """The three depths at which a pixel is looked up in the sources."""

    inverse: Tensor
    """(3, h, w) inverse depths, 1/m: the two of `ViewDepth`, and the LiDAR's."""
    share: Tensor
    """(3, h, w) in 0..1: trust in each."""
    likeliest: Tensor
    """(h, w) int64, which of them is trusted most."""


def render_view(view: CameraView) -> RenderedImage:
    """Render a whole view whose images have depths: its colours, and each pixel's depth of most trust."""
    found = _hypotheses(view)
    points = SeenPoints(plane_rays(view.pinhole), found.inverse, view.label)
    colour, seen = look_up(view.near.of(view.images.full), points, view.pinhole)
    around = _around(view, points, seen)
    levels = at_exposure(_blended(view, points, found, colour, seen, around), view.log_gain)
    image = (levels.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)
    likeliest = found.likeliest[None]
    inverse = found.inverse.gather(0, likeliest)[0]
    shown = seen.gather(1, likeliest.expand(len(seen), *likeliest.shape))[:, 0]
    return RenderedImage(
        image.permute(1, 2, 0).contiguous().numpy(), ray_length(inverse, view.pinhole).numpy(),
        pixel_support(view, inverse, shown).numpy(),
    )  # fmt: skip


def _hypotheses(view: CameraView) -> Hypotheses:
    """Depth hypotheses of a view's pixels."""
    assert view.surfaces is not None
    first, second = view.surfaces.support
    lidar_trust = torch.exp(-view.gap_px / _TRUST_PX)
    return Hypotheses(
        torch.cat([view.surfaces.inverse, view.inverse[None]]),
        torch.cat([view.surfaces.support, lidar_trust[None]]),
        # torch's argmax takes 20 times as long.
        torch.where(lidar_trust > torch.maximum(first, second), 2, (second > first).long()),
    )


def coarse_colour(view: CameraView) -> Tensor:
    """Colours (3, h, w) of a view's shrunk pixels on the front surface, without holes."""
    assert view.surfaces is not None
    small, surface = view.small, view.thinned(view.surfaces.inverse)[:1]
    points = SeenPoints(plane_rays(small), surface, view.label_of())
    agreed = agreement(view.near.of(view.images.small), points, small)
    colour, known = agreed.colour[0], agreed.share[0] > 0.0
    missing = ~known
    colour[:, missing], known[missing] = shown_by_others(
        _others(view, view.images.small), points, small, missing
    )
    return without_holes(colour, known.float())


def _around(view: CameraView, points: SeenPoints, seen: Tensor) -> Tensor:
    """Colours (3, h, w) around a view's pixels; where no source shows anything (`seen`), of other images."""
    around = sample(coarse_colour(view), places_in_small(view))
    missing = holes(~seen.flatten(0, 1).any(dim=0))
    beside, known = shown_by_others(_others(view, view.images.full), points, view.pinhole, missing)
    around[:, missing] = torch.where(known, beside, around[:, missing])
    return around


def _others(view: CameraView, images: Tensor) -> Sources | None:
    """Of all images (j, c, h, w), of any size, those that are not the view's sources."""
    return None if view.others is None else view.others.of(images)


def _blended(
    view: CameraView, points: SeenPoints, found: Hypotheses, colour: Tensor, seen: Tensor, around: Tensor
) -> Tensor:
    """Colours (3, h, w), about 0..1: the sources', brought together, each by how far it is trusted.

    `colour` and `seen` are as of `look_up`, `around` (3, h, w) as of `_around`.
    """
    sources = view.near.of(view.images.full)
    where, likeliest = kernel_inputs(sources, points, view.pinhole), _array(found.likeliest)
    is_seen, around_colour, nearness = _array(seen), _array(around), _array(sources.nearness)
    weight = nearness * nearness
    sharpness = min(max((view.off_path_m - _ON_PATH_M) / (_OFF_PATH_M - _ON_PATH_M), 0.0), 1.0)
    moved = brought_together(where, likeliest, _array(colour), is_seen, around_colour, weight, sharpness)
    trust = source_trust(moved, is_seen, likeliest, around_colour, weight)
    colours = blended(moved, is_seen, _array(found.share), nearness, around_colour, trust, sharpness)
    return torch.from_numpy(colours)


def _array(x: Tensor) -> np.ndarray:
    return np.ascontiguousarray(x.numpy())
