"""Learned rendering of camera views: source images, warped by estimated depths and blended by a network."""

from dataclasses import dataclass

import torch
from torch import Tensor

from nvsf_core.fields.camera_networks import CameraEnsemble, CameraNetworks, DepthNetwork, RefineNetwork
from nvsf_core.kernels.threads import in_parts
from nvsf_core.recipe import CameraSpec
from nvsf_core.rendering.camera_view import WHOLE, CameraView, Window, middle_factor
from nvsf_core.rendering.plane_volume import (
    DepthBelief,
    depth_belief,
    plane_inverses,
    plane_volume,
    volume_features,
    without_holes,
)
from nvsf_core.rendering.rendered import RenderedImage
from nvsf_core.rendering.warping import plane_rays, ray_length, sample

_TRUST_PX = 12.0
"""Distance from a return in the image over which the trust in its depth falls to 1/e."""
_FINER = 0.25
"""Step between refined depths, in steps between planes."""
_JUMP = 1.0
"""Neighbouring depths that differ by more, in steps between planes, belong to two surfaces."""


def planes_of(
    network: DepthNetwork, view: CameraView, spec: CameraSpec, window: Window = WHOLE
) -> tuple[Tensor, Tensor]:
    """Probability (d, h, w) and colour (d, 3, h, w) of a view's d depth planes, at shrunk pixels.

    Args:
        network: Gives the probabilities.
        view: The view.
        spec: Recipe of the camera networks.
        window: Part of the shrunk image.
    """
    inverses, small = plane_inverses(spec, view.device), view.small
    # The first source is the image itself, which tells nothing of a depth but by the others.
    label = view.label_of(view.factor, window)
    sources = view.sources(view.images.small)
    rays = plane_rays(small, view.device)[window]
    volume = plane_volume(sources, rays, small, inverses[:, None, None], label)
    prior, gap_px = (view.thinned(x, view.factor)[window] for x in (view.inverse, view.gap_px))
    features = volume_features(volume, prior, gap_px / view.factor, inverses)
    return network(features).softmax(dim=0), volume.without_first().mean_colour()


@torch.no_grad()
def believe_depth(network: DepthNetwork, view: CameraView, spec: CameraSpec) -> DepthBelief:
    """Likeliest depths of all shrunk pixels of a view; without gradients."""
    probability, colour = planes_of(network, view, spec)
    return depth_belief(probability, colour, plane_inverses(spec, view.device))


@dataclass(frozen=True, slots=True)
class Hypotheses:
    """The three depths at which a pixel is looked up in the sources."""

    inverse: Tensor
    """(3, h, w) inverse depths, 1/m: the two of `ViewDepth`, and the LiDAR's."""
    share: Tensor
    """(3, h, w) in 0..1: trust in each."""

    def resized(self, places: Tensor, jump: float) -> "Hypotheses":
        """Resample at other places: bilinear on a surface, the nearest pixel at an edge.

        A mean across an edge would be a depth where nothing is, visible as a line.

        Args:
            places: (h, w, 2) in grid_sample's coordinates.
            jump: 1/m; where both samplings differ by more there is an edge.
        """
        both = torch.cat([self.inverse, self.share])
        mean, near = sample(both, places), sample(both, places, "nearest")
        is_edge = (mean - near)[: len(self.inverse)].abs() > jump
        inverse, share = torch.where(is_edge.repeat(2, 1, 1), near, mean).chunk(2)
        return Hypotheses(inverse, share)


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
        torch.cat([found, inverse[None]]), torch.cat([support, torch.exp(-gap_px / _TRUST_PX)[None]])
    )


@torch.no_grad()
def coarse_colour(view: CameraView) -> Tensor:
    """Colours (3, h, w) of a view's shrunk pixels on the front surface, without holes."""
    small, sources = view.small, view.sources(view.images.small)
    surface = hypotheses(view, view.factor, WHOLE).inverse[:1]
    label = view.label_of(view.factor, WHOLE)
    volume = plane_volume(sources, plane_rays(small, view.device), small, surface, label)
    return without_holes(volume.mean_colour()[0], volume.seen.any(dim=0)[0].float())


@torch.no_grad()
def view_inverse_depth(networks: CameraEnsemble, view: CameraView, spec: CameraSpec) -> Tensor:
    """Inverse depth (H, W), 1/m, of a view by its depth planes, near returns the LiDAR's: median of the members."""
    trust = torch.exp(-view.gap_px / _TRUST_PX)
    depths = []
    for member in networks:
        belief = believe_depth(member.depth, view, spec)
        places = _places(view, 1, view.factor)
        believed = Hypotheses(belief.inverse, belief.probability).resized(places, _JUMP * _plane_step(spec))
        both = Hypotheses(
            torch.cat([believed.inverse, view.inverse[None]]),
            torch.cat([believed.share * (1.0 - trust), trust[None]]),
        )
        depths.append(_likeliest(both))
    return torch.stack(depths).median(dim=0).values


def _likeliest(found: Hypotheses) -> Tensor:
    """(h, w) inverse depth of most trust, 1/m."""
    return found.inverse.gather(0, found.share.argmax(dim=0, keepdim=True))[0]


def refine(
    network: RefineNetwork, view: CameraView, coarse: Hypotheses, spec: CameraSpec, window: Window = WHOLE
) -> Refinement:
    """Compare depths around each hypothesis on images of the middle size.

    Args:
        network: Gives the probabilities of the depths.
        view: The view.
        coarse: Hypotheses of the window's pixels.
        spec: Recipe of the camera networks.
        window: Part of the image of the middle size.
    """
    count = spec.refinements
    offsets = (torch.arange(count, device=view.device) - count // 2) * _FINER * _plane_step(spec)
    depths = (coarse.inverse.detach()[:, None] + offsets[:, None, None]).clamp_min(0.0).flatten(0, 1)
    middle = view.middle
    label = view.label_of(middle_factor(view.factor), window)
    rays = plane_rays(middle, view.device)[window]
    volume = plane_volume(view.sources(view.images.middle), rays, middle, depths, label)
    spread, pair, shown, _ = volume.agreement()
    probability = network(spread, pair, shown, coarse.share)
    each = probability.reshape(-1, count, *probability.shape[1:])
    share = each.sum(dim=1)
    steps = depths.reshape(each.shape) - coarse.inverse.detach()[:, None]
    moved = (each * steps).sum(dim=1) / share.clamp_min(1e-6)
    return Refinement(Hypotheses(coarse.inverse + moved, share), probability, volume.mean_colour())


def blend_sources(
    networks: CameraNetworks, view: CameraView, spec: CameraSpec, window: Window = WHOLE, around: Window = WHOLE
) -> Blend:
    """Render a window of a view.

    Args:
        networks: For blending and, if the recipe has it, refinement.
        view: The view; its images have depths.
        spec: Recipe of the camera networks.
        window: Part of the view.
        around: Part of the shrunk view, around the window, where depths are refined.
    """
    refinement = None
    if networks.refine is None:
        found = hypotheses(view, 1, window)
    else:
        middle = middle_factor(view.factor)
        part = scaled(around, view.factor // middle)
        refinement = refine(networks.refine, view, hypotheses(view, middle, part), spec, part)
        places = _places(view, 1, middle, part)[window]
        found = refinement.hypotheses.resized(places, _JUMP * _plane_step(spec))
    coarse = sample(coarse_colour(view), _places(view, 1, view.factor)[window])
    sources, rays = view.sources(view.images.full), plane_rays(view.pinhole, view.device)[window]
    volume = plane_volume(sources, rays, view.pinhole, found.inverse, view.label_of(1, window))
    colour = networks.blend(
        volume.colour.permute(2, 0, 1, 3, 4).flatten(0, 1),
        volume.seen.transpose(0, 1).flatten(0, 1),
        found.share,
        coarse,
        view.nearness,
    )
    return Blend(colour, found, refinement)


@torch.no_grad()
def render_view(networks: CameraEnsemble, view: CameraView, spec: CameraSpec) -> RenderedImage:
    """Render a whole view: the mean image of the ensemble, and the median of the members' depths.

    A member's depth of a pixel is its hypothesis of most trust.
    """
    members = list(networks)

    def seen_by(number: int) -> tuple[Tensor, Tensor]:
        member = members[number]
        blend = blend_sources(member, view, spec)
        return blend.colour, _likeliest(blend.hypotheses)

    colours, depths = zip(*in_parts(seen_by, len(members)), strict=True)
    image = (torch.stack(colours).mean(dim=0).clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)
    believed = torch.stack(depths).median(dim=0).values
    return RenderedImage(
        image.permute(1, 2, 0).contiguous().cpu().numpy(), ray_length(believed, view.pinhole).cpu().numpy()
    )


def _plane_step(spec: CameraSpec) -> float:
    """Inverse depth between two planes, 1/m."""
    return (1.0 / spec.near_m - 1.0 / spec.far_m) / (spec.planes - 1)


def scaled(window: Window, by: int) -> Window:
    """The same window in an image `by` times as large."""
    rows, columns = (
        side if side == slice(None) else slice(side.start * by, side.stop * by) for side in window
    )
    return rows, columns


def _places(view: CameraView, factor: int, shrunk_by: int, part: Window = WHOLE) -> Tensor:
    """Places of pixels of the view shrunk by `factor`, in a window of the view shrunk by `shrunk_by`.

    Returns:
        (h, w, 2) in grid_sample's coordinates of the window.
    """
    sides = []
    for length, side in zip((view.pinhole.height, view.pinhole.width), part, strict=True):
        first, last, _ = side.indices(length // shrunk_by)
        place = (torch.arange(length // factor, device=view.device) + 0.5) * factor / shrunk_by - first
        sides.append(place * 2.0 / (last - first) - 1.0)
    return torch.stack(torch.meshgrid(*sides, indexing="ij")[::-1], dim=-1)
