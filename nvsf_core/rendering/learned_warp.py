"""Learned rendering of camera views: recorded images, looked up on a view's surfaces and blended."""

from dataclasses import dataclass

import torch
from torch import Tensor

from nvsf_core.fields.camera_networks import CameraEnsemble, CameraNetworks, RefineNetwork
from nvsf_core.kernels.threads import in_parts
from nvsf_core.recipe import CameraSpec
from nvsf_core.rendering.camera_view import WHOLE, CameraView, Window, middle_factor, places_of
from nvsf_core.rendering.hole_filling import without_holes
from nvsf_core.rendering.pixel_support import pixel_support
from nvsf_core.rendering.plane_depth import FULL_TRUST_PX, plane_step, resized
from nvsf_core.rendering.plane_volume import agreement
from nvsf_core.rendering.rendered import RenderedImage
from nvsf_core.rendering.sources import SeenPoints, look_up
from nvsf_core.rendering.variation import AS_RECORDED, Variation
from nvsf_core.rendering.warping import plane_rays, ray_length, sample

_FINER = 0.25
"""Step between refined depths, in steps between planes."""


@dataclass(frozen=True, slots=True)
class Hypotheses:
    """The three depths at which a pixel is looked up in the sources."""

    inverse: Tensor
    """(3, h, w) inverse depths, 1/m: the two of `ViewDepth`, and the LiDAR's."""
    share: Tensor
    """(3, h, w) in 0..1: trust in each."""


@dataclass(frozen=True, slots=True)
class Refinement:
    """Hypotheses refined by a comparison of c depths around them."""

    hypotheses: Hypotheses
    """Refined."""
    probability: Tensor
    """(c, h, w) of every compared depth."""
    colour: Tensor
    """(c, 3, h, w) mean colour of the sources at these depths."""


@dataclass(frozen=True, slots=True)
class Blend:
    """Colours of a window of a view, blended from its sources."""

    colour: Tensor
    """(3, h, w), about 0..1."""
    hypotheses: Hypotheses
    """Depths at which the sources were looked up."""
    refinement: Refinement | None
    """None for a recipe that does not refine depths."""


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


def refine(
    network: RefineNetwork,
    view: CameraView,
    coarse: Hypotheses,
    spec: CameraSpec,
    window: Window = WHOLE,
    shown_as: Variation = AS_RECORDED,
) -> Refinement:
    """Compare depths around each hypothesis on images of the middle size.

    Args:
        network: Gives the probabilities of the depths.
        view: The view.
        coarse: Hypotheses of the window's pixels.
        spec: Recipe of the camera networks.
        window: Part of the image of the middle size.
        shown_as: Variation of all images.
    """
    count = spec.refinements
    offsets = (torch.arange(count, device=view.device) - count // 2) * _FINER * plane_step(spec)
    depths = (coarse.inverse.detach()[:, None] + offsets[:, None, None]).clamp_min(0.0).flatten(0, 1)
    middle = view.middle
    label = view.label_of(middle_factor(view.factor), window)
    points = SeenPoints(plane_rays(middle, view.device)[window], depths, label)
    agreed = agreement(view.sources(view.images.middle), points, middle, shown_as)
    compared = (agreed.spread, agreed.pair, agreed.share, coarse.share)
    probability = shown_as.turned(network(*(shown_as.turned(x) for x in compared)))
    each = probability.reshape(-1, count, *probability.shape[1:])
    share = each.sum(dim=1)
    steps = depths.reshape(each.shape) - coarse.inverse.detach()[:, None]
    moved = (each * steps).sum(dim=1) / share.clamp_min(1e-6)
    return Refinement(Hypotheses(coarse.inverse + moved, share), probability, agreed.colour)


# Wide: what is rendered (view, coarse, the two windows) and how (networks, spec, variation).
def blend_sources(
    networks: CameraNetworks,
    view: CameraView,
    coarse: Tensor,
    spec: CameraSpec,
    window: Window = WHOLE,
    around: Window = WHOLE,
    shown_as: Variation = AS_RECORDED,
) -> Blend:
    """Render a window of a view.

    Args:
        networks: For blending and, if the recipe has it, refinement.
        view: The view; its images have depths.
        coarse: (3, h, w) of `coarse_colour`.
        spec: Recipe of the camera networks.
        window: Part of the view.
        around: Part of the shrunk view, around the window, where depths are refined.
        shown_as: Variation of all images.
    """
    refinement = None
    if networks.refine is None:
        found = hypotheses(view, 1, window)
    else:
        middle = middle_factor(view.factor)
        part = scaled(around, view.factor // middle)
        refinement = refine(networks.refine, view, hypotheses(view, middle, part), spec, part, shown_as)
        places = places_of(view, 1, middle, part)[window]
        layers = torch.cat([refinement.hypotheses.inverse, refinement.hypotheses.share])
        found = Hypotheses(*resized(layers, places, plane_step(spec)).chunk(2))
    around_colour = sample(shown_as.colours(coarse), places_of(view, 1, view.factor)[window])
    rays = plane_rays(view.pinhole, view.device)[window]
    points = SeenPoints(rays, found.inverse, view.label_of(1, window))
    colour, seen = look_up(view.sources(view.images.full), points, view.pinhole)
    inputs = (
        shown_as.colours(colour.permute(2, 0, 1, 3, 4).flatten(0, 1)),
        seen.transpose(0, 1).flatten(0, 1),
        found.share,
        around_colour,
    )
    shown = networks.blend(*(shown_as.turned(x) for x in inputs), view.nearness)
    return Blend(shown_as.turned(shown), found, refinement)


@torch.no_grad()
def render_view(networks: CameraEnsemble, view: CameraView, spec: CameraSpec) -> RenderedImage:
    """Render a whole view: the mean image of the ensemble, and the median of the members' depths.

    A member's depth of a pixel is its hypothesis of most trust.
    """
    members, coarse = list(networks), coarse_colour(view)

    def seen_by(number: int) -> tuple[Tensor, Tensor]:
        member = members[number]
        blend = blend_sources(member, view, coarse, spec)
        return blend.colour, _likeliest(blend.hypotheses)

    colours, depths = zip(*in_parts(seen_by, len(members)), strict=True)
    image = (torch.stack(colours).mean(dim=0).clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)
    inverse = torch.stack(depths).median(dim=0).values
    return RenderedImage(
        image.permute(1, 2, 0).contiguous().cpu().numpy(), ray_length(inverse, view.pinhole).cpu().numpy(),
        pixel_support(view, inverse).cpu().numpy(),
    )  # fmt: skip


def scaled(window: Window, by: int) -> Window:
    """The same window in an image `by` times as large."""
    rows, columns = (
        side if side == slice(None) else slice(side.start * by, side.stop * by) for side in window
    )
    return rows, columns
