"""Learned rendering of camera views: recorded images, looked up on a view's surfaces and blended."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nvsf_core.fields.camera_networks import BlendInput, CameraNetworks
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.kernels.images.source_agreement import source_trust
from nvsf_core.kernels.images.source_shifts import Surface, brought_together
from nvsf_core.rendering.camera_view import WHOLE, CameraView, Window, places_in_small
from nvsf_core.rendering.image_exposure import at_exposure
from nvsf_core.rendering.pixel_support import holes, pixel_support, shown_by_others, without_holes
from nvsf_core.rendering.plane_depth import FULL_TRUST_PX
from nvsf_core.rendering.plane_volume import agreement
from nvsf_core.rendering.rendered import RenderedImage
from nvsf_core.rendering.sources import SeenPoints, Sources, look_up, pixel_motions
from nvsf_core.rendering.warping import plane_rays, ray_length, sample


@dataclass(frozen=True, slots=True)
class Hypotheses:
    """The three depths at which a pixel is looked up in the sources."""

    inverse: Tensor
    """(3, h, w) inverse depths, 1/m: the two of `ViewDepth`, and the LiDAR's."""
    share: Tensor
    """(3, h, w) in 0..1: trust in each."""


def hypotheses(view: CameraView, factor: int, window: Window) -> Hypotheses:
    """Depth hypotheses in a window of a view shrunk by `factor`.

    Args:
        view: The view; its images have depths.
        factor: By how much the image is shrunk; 1 = not at all.
        window: Part of the image shrunk by `factor`.
    """
    assert view.surfaces is not None
    surfaces = (view.thinned(x, factor)[:, *window] for x in (view.surfaces.inverse, view.surfaces.support))
    inverse, gap_px = (view.thinned(x, factor)[window] for x in (view.inverse, view.gap_px))
    found, support = surfaces
    return Hypotheses(
        torch.cat([found, inverse[None]]), torch.cat([support, torch.exp(-gap_px / FULL_TRUST_PX)[None]])
    )


@torch.no_grad()
def coarse_colour(view: CameraView) -> Tensor:
    """Colours (3, h, w) of a view's shrunk pixels on the front surface, without holes."""
    small = view.small
    surface = hypotheses(view, view.factor, WHOLE).inverse[:1]
    points = SeenPoints(plane_rays(small, view.device), surface, view.label_of(view.factor, WHOLE))
    agreed = agreement(view.near.of(view.images.small), points, small)
    colour, known = agreed.colour[0], agreed.share[0] > 0.0
    missing = ~known
    colour[:, missing], known[missing] = shown_by_others(
        _others(view, view.images.small), points, small, missing
    )
    return without_holes(colour, known.float())


def _others(view: CameraView, images: Tensor) -> Sources | None:
    """Of all images (j, c, h, w), of any size, those that are not the view's sources."""
    return None if view.others is None else view.others.of(images)


def blend_input(view: CameraView, found: Hypotheses, coarse: Tensor, window: Window = WHOLE) -> BlendInput:
    """What a blend network renders a window of a view from.

    Args:
        view: The view; its images have depths.
        found: Depths of the window.
        coarse: (3, h, w) of `coarse_colour`.
        window: Part of the view.
    """
    around_colour = sample(coarse, places_in_small(view)[window])
    rays = plane_rays(view.pinhole, view.device)[window]
    points = SeenPoints(rays, found.inverse, view.label_of(1, window))
    sources = view.near.of(view.images.full)
    colour, seen = look_up(sources, points, view.pinhole)
    missing = holes(~seen.flatten(0, 1).any(dim=0))
    beside, known = shown_by_others(_others(view, view.images.full), points, view.pinhole, missing)
    around_colour[:, missing] = torch.where(known, beside, around_colour[:, missing])
    likeliest = _largest(found.share)
    colour, trust = _together(sources, points, view.pinhole, likeliest, colour, seen, around_colour)
    return BlendInput.of(
        colour.permute(2, 0, 1, 3, 4).flatten(0, 1), seen.transpose(0, 1).flatten(0, 1), found.share,
        around_colour, view.near.nearness, trust,
    )  # fmt: skip


def _together(
    sources: Sources, points: SeenPoints, pinhole: Pinhole, likeliest: Tensor, colour: Tensor, seen: Tensor,
    around: Tensor,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """The sources' colours (k, 3, d, h, w), moved to where all together have what a pixel shows, and trust.

    See `brought_together` and `source_trust`, which run on the CPU wherever the networks do: they are many
    small sums.

    Args:
        sources: Source images of the view.
        points: Of the pixels.
        pinhole: Intrinsics of view and sources.
        likeliest: (h, w) which of the depths is.
        colour: As of `look_up`.
        seen: As of `look_up`.
        around: (3, h, w) colours where no source shows anything.
    """
    motions, label = pixel_motions(sources, points, pinhole)
    surface = Surface(motions, _array(points.rays), label, _array(points.inverse), _array(likeliest))
    is_seen, around_colour, weight = _array(seen), _array(around), _array(sources.nearness.square())
    moved = brought_together(surface, _array(colour), is_seen, around_colour, weight)
    trust = source_trust(moved, is_seen, surface.likeliest, around_colour, weight)
    return torch.from_numpy(moved).to(colour.device), torch.from_numpy(trust).to(colour.device)


def _array(x: Tensor) -> np.ndarray:
    return np.ascontiguousarray(x.cpu().numpy())


def blend_sources(
    networks: CameraNetworks, view: CameraView, coarse: Tensor, window: Window = WHOLE
) -> Tensor:
    """Colours (3, h, w), about 0..1, of a window of a view; arguments as of `blend_input`."""
    found: Tensor = networks.blend(blend_input(view, hypotheses(view, 1, window), coarse, window))
    return at_exposure(found, view.log_gain)


@torch.no_grad()
def render_view(networks: CameraNetworks, view: CameraView) -> RenderedImage:
    """Render a whole view: its colours, and each pixel's depth of most trust."""
    found = hypotheses(view, 1, WHOLE)
    given = blend_input(view, found, coarse_colour(view))
    levels = at_exposure(networks.blend(given), view.log_gain)
    image = (levels.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)
    likeliest = _largest(found.share)[None]
    inverse = found.inverse.gather(0, likeliest)[0]
    by_depth = given.shown[:-1].reshape(len(found.share), -1, *inverse.shape)
    shown = by_depth.gather(0, likeliest.expand(by_depth.shape[1:])[None])[0]
    return RenderedImage(
        image.permute(1, 2, 0).contiguous().cpu().numpy(), ray_length(inverse, view.pinhole).cpu().numpy(),
        pixel_support(view, inverse, shown).cpu().numpy(),
    )  # fmt: skip


def _largest(share: Tensor) -> Tensor:
    """Which of three values (3, h, w) is the largest, (h, w) int64: torch's argmax takes 20 times as long."""
    return torch.where(share[2] > share[:2].amax(dim=0), 2, (share[1] > share[0]).long())
