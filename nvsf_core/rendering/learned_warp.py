"""Learned rendering of camera views: recorded images, looked up on a view's surfaces and blended."""

from dataclasses import dataclass

import torch
from torch import Tensor

from nvsf_core.fields.camera_networks import CameraEnsemble, CameraNetworks
from nvsf_core.kernels.threads import in_parts
from nvsf_core.rendering.camera_view import WHOLE, CameraView, Window, places_in_small
from nvsf_core.rendering.pixel_support import pixel_support, without_holes
from nvsf_core.rendering.plane_depth import FULL_TRUST_PX
from nvsf_core.rendering.plane_volume import agreement
from nvsf_core.rendering.rendered import RenderedImage
from nvsf_core.rendering.sources import SeenPoints, look_up
from nvsf_core.rendering.warping import plane_rays, ray_length, sample


@dataclass(frozen=True, slots=True)
class Hypotheses:
    """The three depths at which a pixel is looked up in the sources."""

    inverse: Tensor
    """(3, h, w) inverse depths, 1/m: the two of `ViewDepth`, and the LiDAR's."""
    share: Tensor
    """(3, h, w) in 0..1: trust in each."""


@dataclass(frozen=True, slots=True)
class Blend:
    """Colours of a window of a view, blended from its sources."""

    colour: Tensor
    """(3, h, w), about 0..1."""
    hypotheses: Hypotheses
    """Depths at which the sources were looked up."""


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
    agreed = agreement(view.sources(view.images.small), points, small)
    return without_holes(agreed.colour[0], (agreed.share[0] > 0.0).float())


def _likeliest(found: Hypotheses) -> Tensor:
    """(h, w) inverse depth of most trust, 1/m."""
    return found.inverse.gather(0, found.share.argmax(dim=0, keepdim=True))[0]


def blend_sources(
    networks: CameraNetworks, view: CameraView, coarse: Tensor, window: Window = WHOLE
) -> Blend:
    """Render a window of a view.

    Args:
        networks: For blending.
        view: The view; its images have depths.
        coarse: (3, h, w) of `coarse_colour`.
        window: Part of the view.
    """
    found = hypotheses(view, 1, window)
    around_colour = sample(coarse, places_in_small(view)[window])
    rays = plane_rays(view.pinhole, view.device)[window]
    points = SeenPoints(rays, found.inverse, view.label_of(1, window))
    colour, seen = look_up(view.sources(view.images.full), points, view.pinhole)
    shown = networks.blend(
        colour.permute(2, 0, 1, 3, 4).flatten(0, 1), seen.transpose(0, 1).flatten(0, 1), found.share,
        around_colour, view.nearness,
    )  # fmt: skip
    return Blend(shown, found)


@torch.no_grad()
def render_view(networks: CameraEnsemble, view: CameraView) -> RenderedImage:
    """Render a whole view: the mean image of the ensemble, and the median of the members' depths.

    A member's depth of a pixel is its hypothesis of most trust.
    """
    members, coarse = list(networks), coarse_colour(view)

    def seen_by(number: int) -> tuple[Tensor, Tensor]:
        member = members[number]
        blend = blend_sources(member, view, coarse)
        return blend.colour, _likeliest(blend.hypotheses)

    colours, depths = zip(*in_parts(seen_by, len(members)), strict=True)
    image = (torch.stack(colours).mean(dim=0).clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)
    inverse = torch.stack(depths).median(dim=0).values
    return RenderedImage(
        image.permute(1, 2, 0).contiguous().cpu().numpy(), ray_length(inverse, view.pinhole).cpu().numpy(),
        pixel_support(view, inverse).cpu().numpy(),
    )  # fmt: skip
